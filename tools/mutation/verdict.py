"""The class of what came of a damaged input."""

from __future__ import annotations

from mutation.running import MEMORY_BYTES, Outcome, Ran

# Exit codes that the README documents for something that is wrong with an input or with what was asked of it.
REFUSALS = (2, 3, 4, 6)
GOOD = ("refused", "told", "no effect", "plausible")
BAD = ("swallowed", "crash", "hang", "memory", "outside", "torn")
CLASSES = (*GOOD, *BAD)
MEANING = {
    "refused": "one message and a documented exit code",
    "told": "a result, and a line on the terminal or in the report that a sound run does not have",
    "no effect": "the same result as without the damage",
    "plausible": "another result without a word; the damage is none that a program can see, see damage.py",
    "swallowed": "another result without a word, though the damage can be seen",
    "crash": "an internal error, a traceback, a signal or an undocumented exit code",
    "hang": "not ended within the time limit",
    "memory": "more than 2 GiB",
    "outside": "a file read or written outside of the input and --out, a process or a socket",
    "torn": "files at --out though the command failed, or temporary ones",
}


def judge(ran: Ran, sound: Outcome, *, visible: bool) -> tuple[str, str]:
    """Return the class and the reason in one line.

    The result that counts is that of the last command, which makes a scenario or a file of one; what the earlier ones, inspect
    and validate, say is no word of the last one.
    """
    if ran.outside:
        return "outside", "; ".join(ran.outside[:3])
    for outcome in ran.outcomes:
        if "MemoryError" in outcome.errors or "bad_alloc" in outcome.errors or "Insufficient memory" in outcome.errors:
            return "memory", f"{outcome.command}: {_first(outcome.errors)}"
        if outcome.code and not _is_refusal(outcome):
            return "crash", f"{outcome.command}: exit code {outcome.code}: {outcome.errors[-300:].strip()}"
        if outcome.left:
            return "torn", f"{outcome.command}: left {', '.join(outcome.left[:5])}"
    if ran.peak_bytes > MEMORY_BYTES:
        return "memory", f"{ran.peak_bytes / 2**20:.0f} MiB"
    last, was = ran.outcomes[-1], sound
    if last.code:
        return "refused", f"{last.command}: {_first(last.errors)}"
    if last.content == was.content:
        return "no effect", ""
    new = sorted(last.told - was.told)
    if new:
        return "told", new[0]
    return ("swallowed" if visible else "plausible"), ""


def _is_refusal(outcome: Outcome) -> bool:
    own = [line for line in outcome.errors.splitlines() if line.startswith("log2sim: ")]
    return (
        outcome.code in REFUSALS
        and len(own) == 1
        and "internal error" not in outcome.errors
        and "Traceback" not in outcome.errors
    )


def _first(errors: str) -> str:
    return next((line for line in errors.splitlines() if line.startswith("log2sim: ")), errors[:200])
