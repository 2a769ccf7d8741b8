"""Notes of readers: what was left out, counted, and notes that are complete once the labels are read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence

from log2sim.errors import LogError


def count_words(words: Iterable[str]) -> str:
    """List words with their numbers, the most frequent first: "car (12), bus (1)"."""
    counts = sorted(Counter(words).items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{word} ({count})" for word, count in counts)


def note_left_out(kinds: Iterable[str], no_road_users: Collection[str], notes: list[str]) -> None:
    """Note the labels that get no category.

    Parameters
    ----------
    kinds : iterable of str
        What the data set calls the object of each label that is left out.
    no_road_users : collection of str
        Kinds that are left out on purpose; others are not known.
    notes : list of str
        Takes a note for either of the two, where there are such labels.
    """
    kinds = list(kinds)
    for reason, known in (("they are no road users", True), ("their kind is not known", False)):
        words = [kind for kind in kinds if (kind in no_road_users) == known]
        if words:
            notes.append(f"labels left out because {reason}: {count_words(words)}")


def note_damaged_rows(damaged: Sequence[str], total: int, notes: list[str]) -> None:
    """Note the rows of a text that are left out because they cannot be read.

    Parameters
    ----------
    damaged : sequence of str
        Where each of them is and what is wrong with it.
    total : int
        Of all rows.
    notes : list of str
        Takes a note where there are such rows.

    Raises
    ------
    LogError
        When no row can be read.
    """
    if damaged and len(damaged) == total:
        raise LogError(damaged[0])
    if damaged:
        notes.append(f"{len(damaged)} of {total} rows of labels are damaged and left out, first: {damaged[0]}")


def defer_notes(notes: list[str], *readings: Callable[[], object]) -> Callable[[], tuple[str, ...]]:
    """Return a function that reads what adds to the notes, such as the labels, and then returns the notes."""

    def read() -> tuple[str, ...]:
        for reading in readings:
            reading()
        return tuple(notes)

    return read
