"""`Problem`: a model, which of its numbers are free, a residual and its data: all that a solver needs."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import ArrayLike, Float, PyTree

from jaximu.ground.array_types import Array
from jaximu.ground.document import Json
from jaximu.ground.tracing import array_module
from jaximu.model.sensor import Board, Imu, Triad

TOLERANCE = 5.0
"""How far, in typical sizes, a parameter may lie from the data sheet (one sigma). A scale may be off by half:
recordings labelled with another range are common, and a tighter tolerance would hold such a fit half way."""
_BIAS_SIZE = {"accelerometer": 1.0, "gyroscope": 0.1, "magnetometer": 20.0}
"""Plausible biases: m/s², rad/s, µT."""


def typical_sizes(imu: Imu) -> Imu:
    """Return an Imu of plausible deviations from a data sheet: they scale the fit, and bound what data cannot tell.

    Of units, with a leading axis on every array, too, unless they have effects.

    Gain 10 % of the axis's scale, accelerometer bias 1 m/s², gyroscope bias 0.1 rad/s, hard iron 20 µT, effects as
    they state.
    """

    def sizes(triad: Triad, bias: float) -> Triad:
        numerics = array_module(triad)
        scale = numerics.linalg.norm(numerics.asarray(triad.gain), axis=-1)
        effects = tuple(effect.typical_sizes(numerics.mean(scale)) for effect in triad.effects)
        gain = 0.1 * numerics.broadcast_to(scale[..., None], (*scale.shape, 3))
        return replace(triad, gain=gain, bias=bias * scale, effects=effects)

    changed: Json = {name: sizes(triad, _BIAS_SIZE[name]) for name, triad in imu.triads().items()}
    if isinstance(imu, Board):
        changed["others"] = tuple(map(typical_sizes, imu.others))
    return replace(imu, **changed, setup=tuple(effect.typical_sizes(1.0) for effect in imu.setup))


def flatten(model: Imu) -> Float[Array, " m"]:
    """Return the numbers of a model in one vector, in the order of `jax.flatten_util.ravel_pytree`."""
    numerics = array_module(model)
    return numerics.concatenate([numerics.ravel(leaf) for leaf in jax.tree.leaves(model)])


def unflatten(like: Imu, flat: Float[Array, "... m"]) -> Imu:
    """Return models of the structure of `like` from vectors (..., m), with their leading axes."""
    leaves, structure = jax.tree.flatten(like)
    ends = pairwise(np.cumsum([0, *map(np.size, leaves)]))
    shaped = [
        flat[..., start:stop].reshape(*flat.shape[:-1], *np.shape(leaf))
        for (start, stop), leaf in zip(ends, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, shaped)


class Name(str):
    """What a free number of a model is called, such as `accelerometer.gain[1,0]`, and what it is.

    owner: "accelerometer", "gyroscope", "magnetometer" or "setup"; of a board's other units "others[0].gyroscope" and
    so on. part: "gain", "bias", "coefficients", or an
    effect's inner parameter. axes: the number's place in it. effect: which of the owner's effects it belongs to; None
    for gain and bias.
    """

    owner: str
    part: str
    axes: tuple[int, ...]
    effect: int | None

    def __new__(cls, owner: str, part: str, axes: tuple[int, ...] = (), effect: int | None = None) -> "Name":
        """Compose the name of its parts."""
        stem = owner if effect is None else f"setup[{effect}]" if owner == "setup" else f"{owner}.effects[{effect}]"
        name = super().__new__(cls, f"{stem}.{part}" + (f"[{','.join(map(str, axes))}]" if axes else ""))
        name.owner, name.part, name.axes, name.effect = owner, part, axes, effect
        return name

    def __getnewargs__(self):
        return self.owner, self.part, self.axes, self.effect

    @property
    def key(self) -> tuple[str, int | None]:
        """Owner and effect, under which `Imu.all_effects` has the effect."""
        return self.owner, self.effect

    @property
    def is_scale(self) -> bool:
        """Whether it is the gain of an axis by itself, not of one across another."""
        return self.part == "gain" and self.axes[0] == self.axes[1]


def names_of(model: Imu) -> tuple[Name, ...]:
    """Return the names of all numbers of a model, in the order of `flatten`."""
    names = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(model)[0]:
        words = [key.name for key in path if isinstance(key, jax.tree_util.GetAttrKey)]
        indices = [key.idx for key in path if isinstance(key, jax.tree_util.SequenceKey)]
        owner = words[0]
        if owner == "others":
            owner, indices = f"others[{indices[0]}].{words[1]}", indices[1:]
        effect = indices[0] if indices else None
        names += [Name(owner, words[-1], axes, effect) for axes in np.ndindex(*np.shape(leaf))]
    return tuple(names)


class Parameters(eqx.Module):
    """The free numbers of a model, as a vector z of order one: value = reference + size · z.

    `index` are their places in the model's raveled leaves, `names` what they are.
    """

    reference: Float[Array, "... m"]  # leading axes: a batch of units, each with its own data sheet
    size: Float[Array, "... p"]
    index: tuple[int, ...] = eqx.field(static=True)
    names: tuple[Name, ...] = eqx.field(static=True)

    @classmethod
    def select(cls, model: Imu, keep: Callable[[Name], bool]) -> "Parameters":
        """Free every number of the model whose name `keep` accepts."""
        names = names_of(model)
        index = tuple(k for k, name in enumerate(names) if keep(name))
        size = flatten(typical_sizes(model))[np.array(index, int)]
        return cls(flatten(model), size, index, tuple(names[k] for k in index))

    def model(self, like: Imu, z: Float[Array, " p"]) -> Imu:
        """Return the model at z; `like` gives the structure."""
        index = np.array(self.index, int)
        flat = jnp.asarray(self.reference).at[index].add(self.size * z)
        return ravel_pytree(like)[1](flat)

    def vector(self, model: Imu) -> Float[Array, " p"]:
        """Return the z of a model."""
        flat = ravel_pytree(model)[0]
        index = np.array(self.index, int)
        return (flat[index] - self.reference[index]) / self.size


_UPPER = ((0, 1), (0, 2), (1, 2))


def without_equipment(name: Name) -> bool:
    """Whether a number is free by hand: the accelerometer's gain is lower triangular, which fixes the frame (S6)."""
    return name.part in ("gain", "bias") and not (
        name.owner == "accelerometer" and name.part == "gain" and name.axes in _UPPER
    )


def without_equipment_or_effects(name: Name) -> bool:
    """Whether a number is free by hand: the numbers of effects, and gain and bias but for the frame."""
    return name.effect is not None or without_equipment(name)


def _huber(residual, width=1.345):
    size = jnp.abs(residual)
    far = size > width
    # sign(r) sqrt(2 rho(r)): its square is the loss, so that a least-squares solver minimises it
    root = jnp.sqrt(jnp.where(far, 2 * width * size - width**2, 1.0))
    return jnp.where(far, jnp.sign(residual) * root, residual)


def _cauchy(residual, width=2.385):
    squared = (residual / width) ** 2
    small = squared < 1e-8
    factor = jnp.sqrt(jnp.where(small, 1 - squared / 2, jnp.log1p(squared) / jnp.where(small, 1.0, squared)))
    return residual * factor


Loss = Literal["linear", "huber", "cauchy"]
LOSSES: dict[str, Callable] = {"linear": lambda residual: residual, "huber": _huber, "cauchy": _cauchy}
"""Losses of whitened residuals, as the signed root that a least-squares solver squares; widths give 95 % efficiency
for normal noise (Holland and Welsch, 1977)."""


class Problem(eqx.Module):
    """Minimise |loss(residual(model(z), data))|² + |z / tolerance|².

    The last term is the data sheet's tolerance: a parameter is known beforehand to some typical sizes, so a problem is
    never singular; where data speak, it counts for less than a millionth.
    """

    like: Imu  # gives the structure of the model; its numbers are the reference
    parameters: Parameters
    data: PyTree
    residual: Callable[[Imu, Any], Float[Array, " n"]] = eqx.field(static=True)
    loss: str = eqx.field(static=True, default="linear")
    tolerance: Float[ArrayLike, ""] = TOLERANCE

    def model(self, z: Float[Array, " p"]) -> Imu:
        """Return the model at z."""
        return self.parameters.model(self.like, z)

    def residuals(self, z: Float[Array, " p"]) -> Float[Array, " n"]:
        """Return the whitened residuals of the data at z, before the loss."""
        return self.residual(self.model(z), self.data)

    def objective(self, z: Float[Array, " p"]) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
        """Return what the solver squares and adds up: the data's part and the tolerance's."""
        return LOSSES[self.loss](self.residuals(z)), z / self.tolerance
