"""A constructor's default is what the configuration says, so that code and command line mean the same by one name."""

import dataclasses
import inspect
from collections import defaultdict

import hydra
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from neural_sim.main import conf_directory

CONF = conf_directory()
# Experiments, scales and variants only override; the paper's numbers are data.
OVERRIDES = {"experiment", "scale", "variant", "hydra", "paper"}
CHOICES = sorted(
    (path.parent.relative_to(CONF).as_posix(), path.stem)
    for path in CONF.glob("*/**/*.yaml")
    if path.relative_to(CONF).parts[0] not in OVERRIDES
)


def composed(*overrides):
    """The configuration twice: with its interpolations and without."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", list(overrides))
    return OmegaConf.to_container(config), OmegaConf.to_container(config, resolve=True)


def nodes(raw, plain):
    """Every node with a ``_target_``, with its interpolations and without."""
    if isinstance(plain, dict):
        if "_target_" in plain:
            yield raw, plain
        for key in plain:
            yield from nodes(raw[key], plain[key])


def of_the_scale(raw):
    """Whether a value is a budget's, which every scale overwrites, or has to be given on the command line."""
    if isinstance(raw, dict):
        return any(of_the_scale(value) for value in raw.values())
    return isinstance(raw, str) and ("${budget." in raw or raw == "???")


def defaults(make):
    """The constructor's defaults by argument."""
    found = {
        name: parameter.default
        for name, parameter in inspect.signature(make).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }
    fields = dataclasses.fields(make) if dataclasses.is_dataclass(make) else ()
    made = {f.name: f.default_factory() for f in fields if f.default_factory is not dataclasses.MISSING}
    return found | {name: value for name, value in made.items() if name in found}


def as_lists(value):
    """A value with its sequences as lists and its dataclasses as mappings, which compare by what they hold."""
    if dataclasses.is_dataclass(value):
        held = {f.name: as_lists(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"class": type(value).__name__, **held}
    return [as_lists(item) for item in value] if isinstance(value, (list, tuple)) else value


def said(compositions):
    """(target, argument) -> all values that nodes of these compositions give it."""
    found = defaultdict(list)
    for raw, plain in compositions:
        for unresolved, node in nodes(raw, plain):
            for key, value in node.items():
                if key.startswith("_") or of_the_scale(unresolved[key]):
                    continue
                if isinstance(value, dict) and "_target_" in value:
                    value = hydra.utils.instantiate(value, _convert_="all")
                if (value := as_lists(value)) not in found[node["_target_"], key]:
                    found[node["_target_"], key].append(value)
    return found


def test_defaults_are_those_of_the_configuration():
    """What the default configuration makes has its values; another choice's class has the choices' own. Where several
    nodes give one argument different values, its default is one of them."""
    ours = said([composed()])
    others = said(
        composed(f"{group}=[{choice}]" if group == "parameter" else f"{group}={choice}")
        for group, choice in CHOICES
    )
    made = {target for target, _ in ours}
    values = ours | {key: value for key, value in others.items() if key[0] not in made}
    known = {target: defaults(hydra.utils.get_object(target)) for target, _ in values}
    wrong = [
        f"{target}.{name}: the configuration says {' or '.join(map(repr, expected))}, the constructor "
        f"{known[target][name]!r}"
        for (target, name), expected in values.items()
        if name in known[target] and as_lists(known[target][name]) not in expected
    ]
    assert len(values) > 150 and not wrong, "\n".join(wrong)
