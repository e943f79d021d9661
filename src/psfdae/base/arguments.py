"""Check of the arguments of public calls, by the types in their signatures."""

from __future__ import annotations

import builtins
import inspect
import re
import reprlib
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, InstanceOf, ValidationError, create_model

from psfdae.base.errors import Error

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class ArgumentError(Error, TypeError, ValueError):
    """An argument has another type, or is not in the range, of its annotation."""


def check_arguments(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorate a function so that it checks its arguments (`check_values`) before it runs.

    Its signature shows each of the keywords that `**options: Unpack[…]` stands for.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def check_and_call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        check_values(function, signature.bind(*args, **kwargs).arguments)
        return function(*args, **kwargs)

    check_and_call.__signature__ = expand_keywords(function, signature)  # type: ignore[attr-defined]
    return check_and_call


def expand_keywords(
    function: Callable[..., Any], signature: inspect.Signature
) -> inspect.Signature:
    """Return a signature with the keys of a TypedDict in place of `**options: Unpack[…]`.

    Parameters
    ----------
    function : callable
        Its module has the TypedDict.
    signature : Signature
        Signature of the function; one without such options is returned as it is.
    """
    parameters: list[inspect.Parameter] = []
    for parameter in signature.parameters.values():
        keywords = re.fullmatch(r"Unpack\[(\w+)\]", str(parameter.annotation))
        if keywords is None:
            parameters.append(parameter)
            continue
        # As in a stub file, `...` stands for a default that is described elsewhere.
        parameters += (
            parameter.replace(
                name=name,
                kind=parameter.KEYWORD_ONLY,
                default=...,
                annotation=reference.__forward_arg__,
            )
            for name, reference in function.__globals__[keywords[1]].__annotations__.items()
        )
    return signature.replace(parameters=parameters)


def check_values(function: Callable[..., Any], values: Mapping[str, Any], **names: Any) -> None:
    """Check values by the annotations of the arguments of a function.

    Numbers may be scalars of numpy. Arguments that are converted to arrays are not checked here.

    Parameters
    ----------
    function : callable
        Function whose annotations are texts (`from __future__ import annotations`).
    values : mapping
        Values by the names of its arguments; other names are ignored.
    **names
        Types of names in the annotations, which override the names of the function's module.

    Raises
    ------
    ArgumentError
        For the first wrong argument; names it and the expected types.
    """
    plain = {n: v.item() if isinstance(v, np.generic) else v for n, v in values.items()}
    try:
        argument_model(function, **names).model_validate(plain)
    except ValidationError as error:
        # All types that are allowed for the first wrong argument.
        problems = error.errors(include_url=False)
        name = str(problems[0]["loc"][0])
        kinds = [p["msg"].removeprefix("Input should be ") for p in problems if p["loc"][0] == name]
        line = f"{name}={reprlib.repr(values[name])}: expected {' or '.join(dict.fromkeys(kinds))}"
        raise ArgumentError(line) from None


@cache
def argument_model(function: Callable[..., Any], **names: Any) -> type[BaseModel]:
    """Return a pydantic model whose fields are the arguments of a function."""
    # Names that are imported only for a type checker stand for any type.
    scope: dict[str, Any] = defaultdict(lambda: Any, vars(builtins) | function.__globals__)
    scope |= {"ArrayLike": Any, "Numbers": Any} | names
    instance_of: Any = InstanceOf  # for mypy, which takes it for a type
    for name, kind in scope.items():
        # Only the class is checked for objects of psfdae.
        if isinstance(kind, type) and kind.__module__.startswith("psfdae"):
            scope[name] = instance_of[kind]
    signature = inspect.signature(function, globals={}, locals=scope, eval_str=True)
    types: dict[str, Any] = {
        name: (parameter.annotation, None)
        for name, parameter in signature.parameters.items()
        if parameter.kind != parameter.VAR_KEYWORD and parameter.annotation != parameter.empty
    }
    options = ConfigDict(strict=True, arbitrary_types_allowed=True, allow_inf_nan=False)
    return create_model("Arguments", __config__=options, **types)


def real_numbers(name: str, values: ArrayLike, error: type[Error] = ArgumentError) -> np.ndarray:
    """Return an array of float32 or float64 in the machine's byte order.

    Raises
    ------
    error
        If the values, called `name` in the message, are not real numbers.
    """
    # Floats of up to 32 bits become float32, all other numbers float64.
    # Texts, complex numbers, lists of different lengths and objects are rejected.
    array = np.asarray(None)
    with suppress(ValueError):
        array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        raise error(f"{name} of type {array.dtype}, expected real numbers")
    is_single = array.dtype.kind == "f" and array.dtype.itemsize <= 4
    return array.astype(np.float32 if is_single else np.float64, copy=False)
