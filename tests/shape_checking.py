"""The type checker with which tests run: it holds every array against its jaxtyping annotation, and nothing else.

pytest's option ``--jaxtyping-packages=neural_sim,shape_checking.checked`` (pyproject.toml) puts it around all functions
and dataclasses of the package. Other annotations are pyright's: at run time they would refuse the tests' stand-ins.

jaxtyping's own decorator binds every call's arguments and checks them twice, also of functions without arrays; tests
would take 1.7 times as long. ``install`` puts one in its place that leaves those functions as they are, and checks what
has the shapes of an earlier call no more.
"""

import dataclasses
import functools
import inspect
import types
import typing

import jaxtyping
import numpy as np
import torch
from beartype import BeartypeConf, beartype

_original = jaxtyping.jaxtyped


def install():
    """Have the package's functions checked as below; to be called before it is imported."""
    jaxtyping.jaxtyped = jaxtyped


def jaxtyped(function=None, *, typechecker=None):
    """Stand in for ``jaxtyping.jaxtyped``."""
    if isinstance(function, str):
        return _original(function)
    if function is None:
        return functools.partial(jaxtyped, typechecker=typechecker)
    if not inspect.isclass(function):
        return checked(function)
    if dataclasses.is_dataclass(function):
        function.__init__ = checked(function.__init__)
    return function


def checked(function):
    """Check the arguments and results of ``function`` whose annotations contain shapes."""
    shapes = {}
    for name, hint in getattr(function, "__annotations__", {}).items():
        resolved = _resolved(hint, function)
        if _has_shape(resolved):
            shapes[name] = resolved
    if not shapes:
        return function
    checking = beartype(_annotated(function, shapes), conf=BeartypeConf(is_pep484_tower=True))
    places = _places(function, shapes)
    # Combinations of shapes and types that were found right: most calls have those of an earlier one.
    right = set()

    @functools.wraps(function)
    def wrapper(*arguments, **named):
        # Exports trace what is computed, with sizes that are symbols.
        if jaxtyping.config.jaxtyping_disable or torch.compiler.is_compiling():
            return function(*arguments, **named)
        if (key := _key(places, arguments, named)) is not None and (key, None) in right:
            result = function(*arguments, **named)
            if "return" not in shapes or (key, _described(result)) in right:
                return result
            given.append(result)
            with _original("context"):
                return answering(*arguments, **named)
        with _original("context"):
            result = checking(*arguments, **named)
        if key is not None:
            right.update([(key, None), (key, _described(result))])
            right.discard((key, UNKNOWN))
        return result

    given = []

    @functools.wraps(function)
    def answer(*arguments, **named):
        return given.pop()

    answer.__signature__, answer.__annotations__ = inspect.signature(function), dict(shapes)
    answering = beartype(answer, conf=BeartypeConf(is_pep484_tower=True))
    return wrapper


UNKNOWN = "what only the whole check can tell"


def _described(value):
    """Say all of an array that a shape's annotation asks for."""
    if value is None:
        return "None"
    if isinstance(value, torch.Tensor | np.ndarray):
        return type(value), tuple(value.shape), value.dtype
    return UNKNOWN


def _places(function, shapes):
    """Return the positions and names of checked parameters, None where one is more than an array."""
    parameters = inspect.signature(function).parameters
    names, checked_names = list(parameters), [name for name in shapes if name != "return"]
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    if any(not _is_array(shapes[name]) or parameters[name].kind in several for name in checked_names):
        return None
    return {**{names.index(name): name for name in checked_names}, **{name: name for name in checked_names}}


def _is_array(hint):
    """Tell whether a hint is an array, or an array or None, and no more."""
    parts = typing.get_args(hint) if typing.get_origin(hint) in (types.UnionType, typing.Union) else (hint,)
    return all(part is type(None) or (isinstance(part, type) and _has_shape(part)) for part in parts)


def _key(places, arguments, named):
    """Return the shapes and types of a call's arrays, None where these cannot be said."""
    if places is None:
        return None
    key = []
    for place, value in (*enumerate(arguments), *named.items()):
        if place in places:
            described = _described(value)
            if described is UNKNOWN:
                return None
            key.append((places[place], described))
    return tuple(key)


def _annotated(function, annotations):
    """Copy a function with other annotations: its own belong to those who read settings' types."""
    plain = inspect.unwrap(function)
    if plain is not function:  # wrapped already, as constructors of settings are

        @functools.wraps(function)
        def copy(*arguments, **named):
            return function(*arguments, **named)

        copy.__signature__ = inspect.signature(function)
    else:
        copy = types.FunctionType(
            function.__code__,
            function.__globals__,
            function.__name__,
            function.__defaults__,
            function.__closure__,
        )
        copy.__kwdefaults__, copy.__qualname__ = function.__kwdefaults__, function.__qualname__
        copy.__module__ = function.__module__
    copy.__annotations__ = dict(annotations)
    return copy


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
