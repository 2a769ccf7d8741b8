"""A dataclass field whose value is made when it is first read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, Self, TypeVar, overload

T = TypeVar("T")


class Deferred(Generic[T]):
    """A dataclass field that also takes a function of no arguments; it is called when the field is first read.

    For parts of a log that have to be read from large files: opening a log does not wait for what is not used. Without
    arguments the field has no default.
    """

    def __init__(self, *default: T) -> None:
        self._default = default

    def __set_name__(self, owner: type, name: str) -> None:
        """Remember the name of the field."""
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type) -> Self: ...

    @overload
    def __get__(self, instance: object, owner: type) -> T: ...

    def __get__(self, instance: object | None, owner: type) -> Any:
        """Return the value; of the class, the default."""
        if instance is None:
            if not self._default:
                raise AttributeError(self._name)
            return self._default[0]
        value = instance.__dict__[self._name]
        if callable(value):
            value = instance.__dict__[self._name] = value()
        return value

    def __set__(self, instance: object, value: T | Callable[[], T]) -> None:
        """Store the value or the function that makes it."""
        instance.__dict__[self._name] = value
