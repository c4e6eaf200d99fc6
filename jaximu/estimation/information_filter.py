"""Square-root information filter and smoother of a linear system with numbers that all steps share.

What is known of the state x (n,) and the shared numbers p (m,) is a triangular system R [x; p] = z whose errors are
white with variance one. A step adds rows of the same kind about the state before it, the state after it and p: how the
state moves, and what is measured. Householder reflections bring all of them to triangular form again; the rows that
then still name the state before are kept for the way back, and the length of what no state can absorb is the step's
normalised innovation (Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, ch. V, VI and X).

All steps together are the QR factorisation of one least-squares problem, so filter and smoother are that problem's
solution by elimination. No inverse of the transition or of a covariance is needed. Steps are few and small, one after
the other: NumPy takes them as quickly as a compiled loop, and needs nothing compiled.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

from jaximu.ground.array_types import Array


class WhiteRows(NamedTuple):
    """White conditions of a step: before · x + after · x_next + shared · p − right has variance one; leading axes."""

    before: Float[Array, "... r n"]
    after: Float[Array, "... r n"]
    shared: Float[Array, "... r m"]
    right: Float[Array, "... r"]


class Knowledge(NamedTuple):
    """What is known of a state and of the shared numbers: root · [x; p] − right has variance one. Upper triangular."""

    root: Float[Array, "... n+m n+m"]
    right: Float[Array, "... n+m"]


class Eliminated(NamedTuple):
    """What a step said of the state before it: root · x − right + onward · [x_next; p] has variance one."""

    root: Float[Array, "... n n"]
    onward: Float[Array, "... n n+m"]
    right: Float[Array, "... n"]


def advance(known: Knowledge, rows: WhiteRows) -> tuple[Knowledge, Eliminated, float]:
    """Return what is known after a step, what it said of the state before, and its normalised innovation squared.

    The last has a χ² distribution with as many degrees of freedom as the step's rows exceed the state's n, once the
    knowledge before it is of full rank.
    """
    n, m = rows.before.shape[-1], rows.shared.shape[-1]
    here, shared = known.root[:, :n], known.root[:, n:]
    old = np.concatenate([here, np.zeros((n + m, n)), shared, known.right[:, None]], axis=1)
    new = np.concatenate([rows.before, rows.after, rows.shared, rows.right[:, None]], axis=1)
    whole = np.asarray(np.linalg.qr(np.concatenate([old, new]), mode="r"))
    gone, rest, last = whole[:n], whole[n : 2 * n + m], whole[2 * n + m :, -1]
    eliminated = Eliminated(gone[:, :n], gone[:, n:-1], gone[:, -1])
    return Knowledge(rest[:, n:-1], rest[:, -1]), eliminated, float(last @ last)


def run(
    start: Knowledge, rows: WhiteRows, ends: Sequence[int] = ()
) -> tuple[Knowledge, Eliminated, Float[Array, "N k"], Knowledge]:
    """Run N steps; return the final knowledge, what each step eliminated, its innovations, and each step's knowledge.

    **Arguments:** `rows`: leading axis N; `ends`: places that part them in k groups. The innovation of a group is what
    it adds to that of the groups before it. Of the knowledge after each step only the part about the shared numbers is
    returned, root (N, m, m) and right (N, m): it holds without the state.
    """
    n, known, steps = rows.before.shape[-1], start, []
    for part in zip(*rows, strict=True):
        sums = [advance(known, WhiteRows(*(array[:end] for array in part)))[-1] for end in ends]
        known, eliminated, innovation = advance(known, WhiteRows(*part))
        innovations = np.diff([0.0, *sums, innovation])
        steps.append((eliminated, innovations, Knowledge(known.root[n:, n:], known.right[n:])))
    eliminated, innovations, numbers = zip(*steps, strict=True)
    return known, _stacked(eliminated), np.array(innovations), _stacked(numbers)


def _stacked(parts):
    """Return like tuples of arrays as one, with a leading axis."""
    return type(parts[0])(*map(np.stack, zip(*parts, strict=True)))


def estimate(known: Knowledge) -> tuple[Float[Array, " k"], Float[Array, "k k"]]:
    """Return the estimate and its covariance of knowledge of full rank."""
    inverse = solve_triangular(known.root, np.eye(known.root.shape[-1]), check_finite=False)
    return inverse @ known.right, inverse @ inverse.T


def smooth(eliminated: Eliminated, state: Float[Array, " n"], shared: Float[Array, " m"]) -> Float[Array, "N n"]:
    """Return the states before each of N steps from all of them: `state` is after the last, `shared` the numbers."""
    states = []
    for root, onward, right in zip(*(array[::-1] for array in eliminated), strict=True):
        state = solve_triangular(root, right - onward @ np.concatenate([state, shared]), check_finite=False)
        states.append(state)
    return np.array(states[::-1])


def smoothed_variances(eliminated: Eliminated, covariance: Float[Array, "n+m n+m"]) -> Float[Array, "N n"]:
    """Return the variances of smoothed states from the covariance of the last state and the shared numbers.

    Rows and columns of numbers that are held are zero.
    """
    n, variances = eliminated.root.shape[-1], []
    m = len(covariance) - n
    numbers = np.concatenate([np.zeros((m, n)), np.eye(m)], axis=1)
    for root, onward in zip(eliminated.root[::-1], eliminated.onward[::-1], strict=True):
        inverse = solve_triangular(root, np.eye(n), check_finite=False)
        back = np.concatenate([-inverse @ onward, numbers])
        covariance = back @ covariance @ back.T
        covariance[:n, :n] += inverse @ inverse.T
        variances.append(np.diagonal(covariance)[:n])
    return np.array(variances[::-1])
