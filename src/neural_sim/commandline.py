"""Check the words of a command line against the groups, choices and keys of ``conf/``, and explain mistakes."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from neural_sim.configuration import UserError, first_line
from neural_sim.extras import require

OWN_WORDS = ("--config-name", "-cn", "--config-path", "-cp", "--shell-completion", "-sc", "--hydra-help")
"""Flags for another configuration or for Hydra itself (completion, help): with them, nothing is checked here."""
FOLDERS = ("--config-dir", "-cd")
PATHS = {
    "objects.root": "a folder that holds a folder for each object",
    "target.root": "the data set's folder",
    "target.annotations": "a COCO file of labelled photographs",
    "synthesis.background.root": "a folder of photographs",
    "synthesis.distractors.root": "a folder of cut-outs",
    "predict.model": "a run's folder, such as outputs/runs/pose_gap/<time>",
    "predict.images": "a picture, a folder or a pattern in quotes",
    "predict.annotations": "a COCO file",
}
"""Keys whose values are paths of a user's own data, and what each path must be."""
OTHER_NAMES = {"device": "trainer=gpu or trainer=cpu", "output": "hydra.run.dir=FOLDER", "gpu": "trainer=gpu"}
"""Words of other programs, and what says the same here."""
WITH_VALUE = (*FOLDERS, "--cfg", "-c", "--package", "-p", "--info", "-i", "--experimental-rerun")
FLAGS = (*WITH_VALUE, "--multirun", "-m", "--run", "-r", "--resolve", "--help", "-h", "--version")


@dataclass(frozen=True)
class Key:
    """A key of a YAML file.

    Attributes:
        value: its text in the file.
        comment: the comment on its line; empty if there is none.
        choice: the file, as ``group=choice``; empty for ``config.yaml``.
    """

    value: str
    comment: str
    choice: str


@dataclass(frozen=True)
class Layout:
    """The configuration's files.

    Attributes:
        folders: ``conf/`` first, then those of ``--config-dir``.
    """

    folders: tuple[Path, ...]

    @cached_property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Choices by group; the name of a group inside another has a slash: ``outer/steps``."""
        found: dict[str, set[str]] = {}
        for folder in self.folders:
            for path in folder.rglob("*.yaml"):
                group = path.parent.relative_to(folder).as_posix()
                if group not in (".", "paper") and not group.startswith("hydra"):
                    found.setdefault(group, set()).add(path.stem)
        return {group: tuple(sorted(found[group])) for group in sorted(found)}

    @property
    def launchers(self) -> set[str]:
        """Names of the launchers of sweeps that are not part of Hydra itself."""
        return {path.stem for path in (self.folders[0] / "hydra" / "launcher").glob("*.yaml")}

    @cached_property
    def defaults(self) -> dict[str, Key]:
        """The groups of the defaults list, with their default choices."""
        lines = (self.folders[0] / "config.yaml").read_text(encoding="utf-8").splitlines()
        found = (re.match(r"  - ([\w/]+): (\[?\w+\]?)\s*(?:# (.*))?$", line) for line in lines)
        return {row[1]: Key(row[2].strip("[]"), row[3] or "", "") for row in found if row}

    @cached_property
    def keys(self) -> dict[str, list[Key]]:
        """Every dotted key of the files, with all its occurrences, those in ``config.yaml`` first."""
        found: dict[str, list[Key]] = {}
        files = [(self.folders[0] / "config.yaml", "", "")]
        for group, choices in self.groups.items():
            for choice, folder in ((c, f) for c in choices for f in self.folders):
                path = folder / group / f"{choice}.yaml"
                if path.is_file():
                    files.append((path, group.replace("/", "."), f"{group}={choice}"))
        for path, package, choice in files:
            text = path.read_text(encoding="utf-8")
            named = re.search(r"^# @package (\S+)", text, re.MULTILINE)
            if named:
                package = "" if named[1] == "_global_" else named[1]
            for key, value, comment in _keys(text):
                whole = f"{package}.{key}" if package else key
                found.setdefault(whole, []).append(Key(value, comment, choice))
        return found

    @cached_property
    def tasks(self) -> tuple[str, ...]:
        """The nodes of ``config.yaml`` that ``stages`` may name in addition to a run's phases."""
        text = (self.folders[0] / "config.yaml").read_text(encoding="utf-8")
        return tuple(re.findall(r"^(\w+):.*\n  _target_: neural_sim\.tasks\.", text, re.MULTILINE))

    @cached_property
    def top(self) -> set[str]:
        """The first parts of all keys and groups."""
        return {key.partition(".")[0] for key in self.keys} | {
            group.partition("/")[0] for group in self.groups
        }


def layout_of(words: Sequence[str], conf: Path) -> Layout | None:
    """Find the files that a command reads; None if it has one of the flags in ``OWN_WORDS``."""
    if any(word.partition("=")[0] in OWN_WORDS for word in words):
        return None
    following = zip(words, (*words[1:], ""), strict=False)
    more = [word.partition("=")[2] or after for word, after in following if word.partition("=")[0] in FOLDERS]
    return Layout((conf, *(Path(folder) for folder in more if Path(folder).is_dir())))


def checked(words: Sequence[str], layout: Layout, commands: Iterable[str] = ()) -> None:
    """Refuse words that cannot be right, before the configuration is composed.

    Hydra proposes ``+detecter=fcos`` for ``detecter=fcos``, and then runs the default detector.

    Args:
        words: words of the command line.
        layout: the files that they are checked against.
        commands: commands that may come first.

    Raises:
        UserError: a word is not a setting, or names an unknown group, choice or top-level key.
    """
    skipped = False
    for before, word, after in zip(("", *words), words, (*words[1:], ""), strict=False):
        if skipped or word.startswith("-"):
            if not skipped and word.partition("=")[0] not in FLAGS:
                raise UserError(_no_flag(word, after, layout))
            skipped = not skipped and word in WITH_VALUE
            continue
        name = word.lstrip("+~")
        key, equals, value = name.partition("=")
        if not equals and not word.startswith("~"):
            raise UserError(_split(before, word, after) or _no_setting(word, layout, commands))
        if key == "hydra/launcher" and value in layout.launchers:
            require("sweeps", word)
        if key.startswith("hydra") or "@" in key:
            continue
        if key == "stages":
            _check_stages(word, value, layout, words)
        elif key in layout.groups:
            _check_choice(word, key, value, layout)
        elif "/" in key:
            raise UserError(f"{key}: no such group{_meant(key, layout.groups)}")
        elif key.partition(".")[0] not in layout.top and not _declared(word, key, value):
            raise UserError(explained(key.partition(".")[0], layout))


def present(words: Sequence[str]) -> None:
    """Refuse paths that do not exist, before anything heavy is imported; patterns and sweeps are not checked.

    Raises:
        UserError: a path does not exist; the message says what the key wants.
    """
    given = {key: value for key, _, value in (word.lstrip("+").partition("=") for word in words)}
    for key, value in given.items():
        path = value.strip("\"'")
        plain = key in PATHS and path != "null" and not set(path) & set("*?[{$,")
        if plain and not Path(path).expanduser().exists():
            raise UserError(f"{key}: {path} does not exist; want {PATHS[key]}")


def _check_stages(word: str, value: str, layout: Layout, words: Sequence[str]) -> None:
    phases = re.findall(r"\w+", layout.keys["stages"][0].value)
    own = {other.lstrip("+").partition("=")[0].partition(".")[0] for other in words}
    if re.fullmatch(r"[\w,-]+", value):
        raise UserError(f"{word}: want a list, in quotes: 'stages=[{value}]'")
    for stage in re.findall(r"[\w-]+", value) if "$" not in value else ():
        if stage not in phases and stage not in layout.top | own:
            known = [*phases, *layout.tasks]
            raise UserError(
                f"{word}: no stage {stage}{_meant(stage, known)}; want some of {', '.join(known)}"
            )


def _declared(word: str, key: str, value: str) -> bool:
    """Return whether a word adds something of the user's own, such as a task."""
    return word.startswith("+") and (key.endswith("._target_") or "_target_" in value)


def _split(before: str, word: str, after: str) -> str:
    """Say where spaces have split a setting; empty: they have not."""
    key, _, value = before.lstrip("+").partition("=")
    is_open = sum(map(before.count, "[{")) > sum(map(before.count, "]}"))
    if is_open or (key in PATHS and Path(f"{value} {word}").exists()):
        return f"{before} {word}: spaces end a setting; want quotes about it: '{before} {word}'"
    if after.startswith("="):
        return f"{word} {after}: want {word}={after.lstrip('=') or '...'}, without spaces"
    return ""


def _no_flag(word: str, after: str, layout: Layout) -> str:
    """Say what to type instead of ``--scale smoke``, ``--scale=smoke`` or ``--smoke``."""
    name, equals, value = word.lstrip("-").partition("=")
    name = name if name in layout.keys else name.replace("-", "_")
    if name in layout.groups or name in layout.keys:
        value = value or after or "..."
        return f"{word}{'' if equals or not after else f' {after}'}: want {name}={value}, without dashes"
    chosen = _choosing(name, layout)
    meant = f"; want {' or '.join(chosen)}" if chosen else _meant(name, layout.top)
    return f"{word}: no such flag{meant or '; want key=value, such as seed=1, or --help'}"


def _choosing(word: str, layout: Layout) -> list[str]:
    """Return the settings that choose ``word``."""
    return [f"{group}={word}" for group, choices in layout.groups.items() if word in choices]


def _no_setting(word: str, layout: Layout, commands: Iterable[str]) -> str:
    if word in layout.groups.get("experiment", ()):
        return f"{word}: want +experiment={word}"
    if word in layout.groups:
        plus = "" if word in layout.defaults else "+"
        return f"{word}: want {plus}{word}= and one of {', '.join(layout.groups[word])}"
    if re.fullmatch(r"[\d.]+", word):
        return f"{word}: want key=value; values of a sweep are joined by commas, such as -m seed=0,1,2"
    if chosen := _choosing(word, layout):
        return f"{word}: want {' or '.join(chosen)}"
    meant = _meant(word, {*commands, *layout.groups.get("experiment", ())})
    if meant and " " not in word:
        return f"{word}: no such command or experiment{meant}"
    if Path(word).is_dir():
        return f"{word}: want objects=photos objects.root={word}, or objects=folder for meshes"
    return f"{word}: want key=value, such as seed=1 (in quotes if it has spaces), or --help"


def _check_choice(word: str, group: str, value: str, layout: Layout) -> None:
    if group not in layout.defaults and "/" not in group and not word.startswith(("+", "~")):
        raise UserError(f"{word}: want +{word}, because it has no default")
    if group in layout.defaults and word.startswith("+"):
        raise UserError(f"{word}: want {word.lstrip('+')}, because it has a default")
    if "(" in value or "$" in value:  # Hydra's own sweep syntax, or an interpolation
        return
    for choice in (part.strip(" []'\"") for part in value.split(",")):
        if choice and choice != "null" and choice not in layout.groups[group]:
            meant = _meant(choice, layout.groups[group], f"{group}=")
            wanted = f"; want one of {', '.join(layout.groups[group])}" if group != "experiment" else ""
            raise UserError(f"{group}={choice}: no such choice{meant or wanted}")


def worded(error: BaseException, layout: Layout | None) -> str:
    """Return one of Hydra's composition errors as one line that says what to type instead."""
    missing = re.search(r"Could not (?:override|append to) '?([\w.]+)", str(error))
    if missing is not None and layout is not None:
        return explained(missing[1], layout)
    several = re.search(r"Ambiguous value for argument '(([^=]+)=([^']*))'", str(error))
    if several is not None:
        word, key, values = several.groups()
        return f"{word}: want -m {word} for a run of each value, or '{key}=[{values}]' for a list"
    word = getattr(error, "override", None)
    if word is not None:  # Hydra's grammar could not read it
        return f"{word}: cannot be read ({first_line(error)}); check its brackets and quotes"
    return first_line(error)


def explained(key: str, layout: Layout) -> str:
    """Return a message for a key that does not exist: which one may be meant, or which choices have it."""
    if key in layout.keys:
        having = sorted({at.choice for at in layout.keys[key] if at.choice})
        groups = [choice for choice in having if not choice.startswith("experiment=")]
        wanted = groups or [f"+{choice}" for choice in having][:5]
        return f"{key}: the chosen groups have no such key; want {' or '.join(wanted)}"
    parent, _, last = key.rpartition(".")
    beside = {other.rpartition(".")[2] for other in layout.keys if other.rpartition(".")[0] == parent}
    # The name may be right and the place wrong.
    elsewhere = [other for other in layout.keys if other.endswith(f".{last}")]
    meant = _close(last, beside if parent else layout.top, 0.8 if elsewhere else 0.6)
    if key in OTHER_NAMES:
        return f"{key}: unknown key; want {OTHER_NAMES[key]}"
    near = [*(f"{parent}.{one}" if parent else one for one in meant), *elsewhere][:3]
    return f"{key}: unknown key" + (f"; did you mean {' or '.join(near)}?" if near else "")


def _meant(word: str, known: Iterable[str], prefix: str = "") -> str:
    close = _close(word, known)
    return f"; did you mean {' or '.join(prefix + one for one in close)}?" if close else ""


def _close(word: str, known: Iterable[str], cutoff: float = 0.6) -> list[str]:
    known = sorted(known)
    return (
        difflib.get_close_matches(word, known, 3, cutoff)
        or [one for one in known if one.startswith(word)][:3]
    )


def _keys(text: str) -> Iterator[tuple[str, str, str]]:
    """Yield the dotted keys of a YAML file with their values' text and their lines' comments."""
    above: list[tuple[int, str]] = []
    for line in text.splitlines():
        row = re.match(r"( *)([\w.]+):(?: +(.*?))?(?:\s+# (.*))?$", line)
        if row is None or line.lstrip().startswith("#"):
            continue
        while above and above[-1][0] >= len(row[1]):
            above.pop()
        above.append((len(row[1]), row[2]))
        key = ".".join(name for _, name in above)
        value, comment = row[3] or "", row[4] or ""
        if value.startswith("#"):
            value, comment = "", value.lstrip("# ")
        if key.startswith(("defaults", "hydra")) or key.endswith(("_target_", "_partial_")):
            continue
        yield key, value, comment
        for inner in _inline(value):
            yield f"{key}.{inner}", "", ""


def _inline(value: str) -> Iterator[str]:
    """Yield the keys of a mapping that is written on one line."""
    if not value.startswith("{"):
        return

    def below(node: Any, prefix: str) -> Iterator[str]:
        if isinstance(node, Mapping):
            for name, inner in node.items():
                yield f"{prefix}{name}"
                yield from below(inner, f"{prefix}{name}.")

    try:
        yield from below(yaml.safe_load(value), "")
    except yaml.YAMLError:
        return
