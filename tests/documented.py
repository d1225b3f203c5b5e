"""The commands that README.md, CONTRIBUTING.md and docs/*.md show, taken apart into words as a shell does."""

from __future__ import annotations

import ast
import itertools
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from neural_sim.guide import spoken

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
PROGRAMS = re.compile(
    r"(\w+=\S+\s+)*(python (-m src\.main|benchmarks/)|neural-sim\b|nox\b|mlflow ui\b|pip install\b)"
)
FLAGS = {"-m", "--multirun", "--help"}


@dataclass(frozen=True)
class Command:
    """One command: ``where`` it stands (page and line), and its words without variables set before it."""

    where: str
    words: tuple[str, ...]

    @property
    def kind(self) -> str:
        """``main``, ``benchmark``, ``nox``, ``mlflow`` or ``pip``."""
        if self.words[:3] == ("python", "-m", "src.main"):
            return "main"
        return {"python": "benchmark", "neural-sim": "main"}.get(self.words[0], self.words[0])

    @property
    def arguments(self) -> tuple[str, ...]:
        """What comes after the program's name, of one to three words; ``demo`` and the like as what they stand for."""
        program = {"python": 3 if self.kind == "main" else 2, "mlflow": 2, "pip": 2}.get(self.words[0], 1)
        rest = self.words[program:]
        return tuple(spoken(rest)) if self.kind == "main" else rest

    @property
    def flags(self) -> set[str]:
        return {word for word in self.arguments if word.startswith("-")}

    @property
    def overrides(self) -> list[str]:
        """Of a run: its arguments that are no flags."""
        return [word for word in self.arguments if not word.startswith("-")]

    @property
    def swept(self) -> dict[str, str]:
        """What the experiment itself sweeps."""
        names = [word.split("=")[1] for word in self.overrides if word.startswith("+experiment=")]
        return swept_by(names[0]) if len(names) == 1 and re.fullmatch(r"\w+", names[0]) else {}

    @property
    def multirun(self) -> bool:
        return bool(self.flags & {"-m", "--multirun"}) or bool(self.swept)

    def jobs(self, seeds: int | None = None) -> list[list[str]]:
        """The overrides of each of a run's jobs, as Hydra's sweeper makes them; with ``seeds``, of so many seeds, and
        of so many values of all else that an experiment sweeps by itself, which would be a hundred jobs."""
        return [list(job) for job in itertools.product(*self._options(seeds))]

    def cut(self, seeds: int) -> list[str]:
        """The overrides with the first ``seeds`` seeds of a sweep alone."""
        return [
            f"{options[0].split('=')[0]}={','.join(option.split('=', 1)[1] for option in options)}"
            if len(options) > 1 else options[0]
            for options in self._options(seeds)
        ]  # fmt: skip

    def _options(self, seeds: int | None) -> Iterator[list[str]]:
        if not self.multirun:
            yield from ([word] for word in self.overrides)
            return
        found: dict[
            str, list[str]
        ] = {}  # the command line's in the place of the experiment's, as Hydra has it
        written = [*(f"{key}={values}" for key, values in self.swept.items()), *self.overrides]
        for override in OverridesParser.create().parse_overrides(written):
            key = override.get_key_element()
            if override.is_sweep_override():
                values = [f"{key}={value}" for value in override.sweep_string_iterator()]
            else:
                values = [str(override.input_line)]
            found[key] = values[:seeds] if key == "seed" or key in self.swept else values
        yield from found.values()


def swept_by(experiment: str) -> dict[str, str]:
    """The parameters that a study, an experiment that is a sweep, sweeps by itself."""
    path = ROOT / "conf" / "experiment" / f"{experiment}.yaml"
    node = OmegaConf.to_container(OmegaConf.load(path), resolve=False) if path.is_file() else {}
    sweeper = node.get("hydra", {}).get("sweeper", {}) if isinstance(node, dict) else {}
    return {key: str(values) for key, values in sweeper.get("params", {}).items()}


def commands(kind: str | None = None) -> list[Command]:
    """All commands on all pages in their order, or those of one kind; one that stands twice counts once."""
    found: dict[tuple[str, ...], Command] = {}
    for page in PAGES:
        for command in commands_in(page.read_text(encoding="utf-8"), page.name):
            found.setdefault(command.words, command)
    return [command for command in found.values() if kind in (None, command.kind)]


def commands_in(text: str, name: str) -> Iterator[Command]:
    """Commands of a Markdown text: lines of code blocks, and code in the text, that begin with a known program."""
    for line, code in sorted([*_blocks(text), *spans(text)]):
        for part in _parts(code) if PROGRAMS.search(code) else []:
            if PROGRAMS.match(part):
                words = shlex.split(part, comments=True)
                while re.fullmatch(r"\w+=.*", words[0]):  # OMP_NUM_THREADS=1 python ...
                    words = words[1:]
                if "COMMAND" not in words:  # stands for any
                    yield Command(f"{name}:{line}", tuple(words))


def _parts(code: str) -> list[str]:
    """What && or ; joins, split outside of quotes and comments."""
    lexer = shlex.shlex(code, posix=False, punctuation_chars="&;")
    lexer.whitespace_split, lexer.commenters = True, "#"
    parts: list[list[str]] = [[]]
    for word in lexer:
        if set(word) <= {"&", ";"}:
            parts.append([])
        else:
            parts[-1].append(word)
    return [" ".join(part) for part in parts]


def _is_code(text: str) -> list[bool]:
    """Which lines are code: between fences, or indented by four after an empty line or other code."""
    fenced, before, held = False, True, []
    for line in text.splitlines():
        fence = line.lstrip().startswith("```")
        code = not fence and (fenced or (before and line.startswith("    ") and bool(line.strip())))
        fenced ^= fence
        before = code or not line.strip()
        held.append(code)
    return held


def _blocks(text: str) -> Iterator[tuple[int, str]]:
    joined, begun = "", 0
    for number, (line, code) in enumerate(zip(text.splitlines(), _is_code(text), strict=True), 1):
        if code:
            begun = begun if joined else number
            joined += line.strip()
            if joined.endswith("\\"):
                joined = joined[:-1]
                continue
            yield begun, joined
        joined = ""


def spans(text: str) -> Iterator[tuple[int, str]]:
    """Code in running text, over line ends; with the line that it begins at."""
    lines = zip(text.splitlines(), _is_code(text), strict=True)
    prose = "\n".join("" if code else line for line, code in lines)
    for match in re.finditer(r"(?<!`)`((?:(?!\n\n)[^`])+)`(?!`)", prose):
        yield prose.count("\n", 0, match.start()) + 1, " ".join(match[1].split())


def nox_sessions() -> set[str]:
    """Names of the functions of noxfile.py that are sessions."""
    tree = ast.parse((ROOT / "noxfile.py").read_text(encoding="utf-8"))
    return {
        node.name
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and any(ast.unparse(decorator).startswith("nox.session") for decorator in node.decorator_list)
    }
