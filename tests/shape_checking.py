"""The type checker with which tests run: it holds every array against its jaxtyping annotation, and nothing else.

pytest's option ``--jaxtyping-packages=neural_sim,shape_checking.checked`` (pyproject.toml) puts it around all functions
and dataclasses of the package. Other annotations are pyright's: at run time they would refuse the tests' stand-ins.
"""

import inspect
import typing

import jaxtyping
from beartype import BeartypeConf, beartype


def checked(function):
    """Check the arguments and results of ``function`` whose annotations contain shapes."""
    shapes = {}
    for name, hint in function.__annotations__.items():
        resolved = _resolved(hint, function)
        if _has_shape(resolved):
            shapes[name] = resolved
    if not shapes:
        return function
    function.__annotations__ = shapes
    return beartype(function, conf=BeartypeConf(is_pep484_tower=True))


def _resolved(hint, function):
    if not isinstance(hint, str):
        return hint
    try:
        return eval(hint, inspect.unwrap(function).__globals__)
    except NameError:  # imported for pyright alone, or the class that is being defined: neither is an array
        return typing.Any


def _has_shape(hint):
    if isinstance(hint, type) and not typing.get_args(hint):
        return issubclass(hint, jaxtyping.AbstractArray)
    return any(_has_shape(part) for part in typing.get_args(hint))
