"""States of a traffic light over time from what single pictures say: a hidden Markov model with the durations of programs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from log2sim.geometry import Array
from log2sim.signals.lamps import STATES

# Mean durations in s (RiLSA 2015 and MUTCD 2023: red and green of tens of seconds, yellow 3 to 6 s, red with yellow 1 to 2 s), and
# what follows: shares of the next states. What no program does happens still, where pictures or boxes are mixed up.
DURATION_S = {"red": 30.0, "red_yellow": 1.2, "yellow": 3.5, "green": 25.0, "off": 60.0}
FOLLOWS = {
    "red": {"green": 0.45, "red_yellow": 0.53, "off": 0.01, "yellow": 0.01},
    "red_yellow": {"green": 0.97, "red": 0.03},
    "yellow": {"red": 0.95, "off": 0.03, "green": 0.02},
    "green": {"yellow": 0.97, "red": 0.02, "off": 0.01},
    "off": {"yellow": 0.5, "red": 0.4, "green": 0.1},
}
# Without a picture a state is taken to last this long, half of the shortest that drivers see.
HOLD_S = 0.6
# A signal that shows the same before and after a gap has not changed meanwhile: away and back takes at least a shortest green (5 s)
# or a yellow and a red.
LEAST_CYCLE_S = 5.0
MIN_STATE_S = 0.25  # shorter changes are of single pictures


def rates() -> Array:
    """Return the rates (S, S) per s of the changes from each of `STATES` to each."""
    out = np.zeros((len(STATES), len(STATES)))
    for k, state in enumerate(STATES):
        for following, share in FOLLOWS[state].items():
            out[k, STATES.index(following)] = share / DURATION_S[state]
        out[k, k] = -out[k].sum()
    return out


def most_probable_states(t_s: Array, evidence: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the most probable course of states (T,), and the probability (T,) of each given all pictures.

    Parameters
    ----------
    t_s : (T,), s
        Increasing times of pictures; equal ones are of several cameras.
    evidence : (T, S)
        Log-likelihoods of `STATES`.

    Notes
    -----
    Viterbi (1967) for the course, forward-backward (Rabiner 1989) for the probabilities, with the transitions of a Markov process
    in continuous time.
    """
    gaps = np.round(np.diff(t_s), 3)
    of_gap = {gap: expm(rates() * gap) for gap in set(gaps.tolist())}
    steps = [of_gap[gap] for gap in gaps.tolist()]
    count = len(STATES)
    best, origin = np.zeros((len(t_s), count)), np.zeros((len(t_s), count), np.intp)
    best[0] = evidence[0]
    forward, backward = np.zeros((len(t_s), count)), np.ones((len(t_s), count))
    likelihood = np.exp(evidence - evidence.max(axis=1, keepdims=True))
    forward[0] = likelihood[0] / likelihood[0].sum()
    for k, step in enumerate(steps):
        paths = best[k][:, None] + np.log(np.maximum(step, 1e-12))
        origin[k + 1] = paths.argmax(axis=0)
        best[k + 1] = paths.max(axis=0) + evidence[k + 1]
        forward[k + 1] = (forward[k] @ step) * likelihood[k + 1]
        forward[k + 1] /= forward[k + 1].sum()
    for k in range(len(steps) - 1, -1, -1):
        backward[k] = steps[k] @ (likelihood[k + 1] * backward[k + 1])
        backward[k] /= backward[k].sum()
    course = np.zeros(len(t_s), np.intp)
    course[-1] = int(best[-1].argmax())
    for k in range(len(steps), 0, -1):
        course[k - 1] = origin[k, course[k]]
    posterior = forward * backward
    posterior /= posterior.sum(axis=1, keepdims=True)
    return course, posterior[np.arange(len(t_s)), course]


def changes_of(t_s: Array, course: NDArray[np.intp]) -> tuple[Array, list[str]]:
    """Return times (K,), s, and states from each time on: a course at times (T,) with "unknown" where no picture tells."""
    times, states = [float(t_s[0])], [STATES[course[0]]]
    for k in range(1, len(t_s)):
        state, gap = STATES[course[k]], t_s[k] - t_s[k - 1]
        if gap > (LEAST_CYCLE_S if state == states[-1] else 2 * HOLD_S):
            times += [float(t_s[k - 1] + HOLD_S), float(t_s[k] - HOLD_S / 2)]
            states += ["unknown", state]
        elif state != states[-1]:
            times.append(float(t_s[k - 1] + t_s[k]) / 2)
            states.append(state)
    times.append(float(t_s[-1] + HOLD_S))
    states.append("unknown")
    kept = [k for k in range(len(times)) if k + 1 == len(times) or times[k + 1] - times[k] >= MIN_STATE_S]
    merged = [k for n, k in enumerate(kept) if n == 0 or states[k] != states[kept[n - 1]]]
    return np.array([times[k] for k in merged]), [states[k] for k in merged]
