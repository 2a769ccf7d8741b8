"""JSON texts in which no key occurs twice."""

from __future__ import annotations

import json
from functools import partial
from typing import Any


class RepeatedKeysError(ValueError):
    """Keys of a JSON text that occur twice in one object; the text says how many, and the first of them."""


def parse_unique(text: str, **hooks: Any) -> Any:
    """Parse a JSON text in which no key occurs twice in one object.

    Parameters
    ----------
    text : str
    **hooks
        Parsers of numbers, as `json.loads` takes them.

    Raises
    ------
    RepeatedKeysError
        For keys that do; all others are found first.
    ValueError
        For what is no JSON.
    """
    repeated: list[str] = []
    value = json.loads(text, object_pairs_hook=partial(_unique, repeated), **hooks)
    require_unique(repeated)
    return value


def unique_decoder(repeated: list[str]) -> json.JSONDecoder:
    """Return a decoder of JSON that adds the keys to `repeated` that occur twice in one object."""
    return json.JSONDecoder(object_pairs_hook=partial(_unique, repeated))


def require_unique(repeated: list[str]) -> None:
    """Raise `RepeatedKeysError` where there are keys that occur twice."""
    if repeated:
        count = f"{len(repeated)} keys occur" if len(repeated) > 1 else "a key occurs"
        raise RepeatedKeysError(
            f"{count} twice in one object, first {repeated[0][:40]!a}; remove the one of the two that is wrong"
        )


def _unique(repeated: list[str], pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) < len(pairs):
        seen = set[str]()
        for key, _ in pairs:
            if key in seen:
                repeated.append(key)
            seen.add(key)
    return value
