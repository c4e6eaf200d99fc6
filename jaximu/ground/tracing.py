"""One text for arrays on the host and for arrays that are being traced."""

import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

Result = TypeVar("Result")
State = TypeVar("State")
Tree = TypeVar("Tree")


def is_traced(*trees: Any) -> bool:
    """Return whether JAX is tracing any array of these."""
    if "jax" not in sys.modules:
        return False
    import jax
    from jax.core import Tracer

    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def array_module(*trees: Any) -> Any:
    """Return `jax.numpy` where any array of these is being traced, else NumPy: eager JAX compiles every operation."""
    if is_traced(*trees):
        import jax.numpy

        return jax.numpy
    import numpy

    return numpy


def padded_size(size: int, least: int = 8) -> int:
    """Return the size that an axis is padded to: few sizes, so few programs to compile, and each of them in little.

    Between powers of two there is one more, and beyond 512 there are three.
    """
    power = 1 << (max(size, least) - 1).bit_length()
    step = power // (4 if power <= 512 else 8)
    return -(-max(size, least) // step) * step


def part_of(tree: Any, places: Any) -> Any:
    """Return the entries at some places along the leading axis of every array: a number, numbers or a slice."""
    import jax

    return jax.tree.map(lambda leaf: array_module(leaf, places).asarray(leaf)[places], tree)


def first(tree: Tree) -> Tree:
    """Return the first entry along the leading axis of every array."""
    return part_of(tree, 0)


def lifted(tree: Tree) -> Tree:
    """Return every array with a leading axis of length one."""
    import jax

    return jax.tree.map(lambda leaf: array_module(leaf).asarray(leaf)[None], tree)


def on_host(tree: Tree) -> Tree:
    """Return every array as one of NumPy."""
    import jax
    import numpy

    return jax.tree.map(numpy.asarray, tree)


def stacked(trees: Sequence[Tree]) -> Tree:
    """Return trees alike as one, every array with a leading axis."""
    import jax

    return jax.tree.map(lambda *leaves: array_module(leaves).stack(leaves), *trees)


def repeated(step: Callable[[State], State], state: State, times: int, *others: Any) -> State:
    """Return a state after so many steps: one after the other, or where JAX traces it or `others`, in a loop of JAX.

    The loop has a derivative both ways.
    """
    if not is_traced(state, others):
        for _ in range(times):
            state = step(state)
        return state
    import jax

    state = jax.tree.map(jax.numpy.asarray, state)
    return jax.lax.scan(lambda before, _: (step(before), None), state, length=times)[0]


def one_by_one(function: Callable[..., Result], *trees: Any) -> Result:
    """Return what a function makes of each entry along the leading axis of every array, along a leading axis."""
    import jax

    if is_traced(trees):
        return jax.lax.map(lambda entry: function(*entry), trees)
    count = len(jax.tree.leaves(trees)[0])
    results = [function(*jax.tree.map(lambda leaf, k=k: leaf[k], trees)) for k in range(count)]
    return stacked(results)
