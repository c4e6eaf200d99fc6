"""Everyday recordings on top of `hidden_effects`: motions and logs that statistics can trip over.

As there, nothing comes from the library under test. A `Trial` is a `Case` with something done to its motion before it
is sampled, or to its samples afterwards.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import hidden_effects as hidden
import numpy as np
from scipy.signal import lfilter

__all__ = ["Trial", "instants", "swaying", "with_jitter", "with_losses", "with_outliers"]


# What is done to the motion, or to the samples ------------------------------------------------------------------------


def swaying(world, random, degrees):
    """The motion with a hand's sway on it: rotations that wander by so much, of a correlation time of two seconds."""
    drawn = random.standard_normal((len(world.time), 3))
    for time_constant in (2.0, 0.3):
        kept = np.exp(-world.step / time_constant)
        drawn = np.asarray(lfilter([1 - kept], [1, -kept], drawn, axis=0))
    edges = np.radians(degrees) * drawn / drawn.std()
    edges = np.concatenate([edges[:1], edges])
    small, middle = hidden.exp(edges), hidden.exp((edges[1:] + edges[:-1]) / 2)
    own = hidden.exp(world.rate * world.step)
    rate = hidden.log(small[:-1].swapaxes(1, 2) @ own @ small[1:]) / world.step
    force = np.einsum("nji,nj->ni", middle, world.force)
    turning = np.gradient(rate, world.step, axis=0)
    return replace(world, attitude=world.attitude @ middle, rate=rate, angular_acceleration=turning, force=force)


def instants(world, random, fine):
    """The motion as a sensor sees it that samples an instant: each sample's sub-steps are all as its middle one."""
    place = np.arange(len(world.time)) // fine * fine + fine // 2
    return replace(
        world, rate=world.rate[place], force=world.force[place], angular_acceleration=world.angular_acceleration[place]
    )


def with_outliers(recording, random, share):
    """One value in a thousand is off by twenty standard deviations."""
    changed = {}
    for sensor in ("accel", "gyro"):
        values = getattr(recording, sensor).copy()
        rate = 1 / np.median(np.diff(recording.time))
        rows = np.flatnonzero(random.random(len(values)) < share)
        signs = random.choice([-1.0, 1.0], len(rows))
        values[rows, random.integers(3, size=len(rows))] += 20 * hidden.WHITE[sensor] * np.sqrt(rate) * signs
        changed[sensor] = values
    return replace(recording, **changed)


def with_losses(recording, random, share):
    """Samples are lost and the others stamped as if none were."""
    kept = random.random(len(recording.time)) >= share
    count = int(kept.sum())
    columns = {name: getattr(recording, name)[kept] for name in ("accel", "gyro", "temperature")}
    return replace(recording, time=recording.time[:count], **columns)


def with_jitter(recording, random, spread):
    """Stamps jitter; the samples are even."""
    return replace(recording, time=recording.time + spread * random.standard_normal(len(recording.time)))


@dataclass(frozen=True, eq=False)
class Trial(hidden.Case):
    """A case with something done to its motion (`moved`) or to what is logged (`logged`, of the recording at rest, too,
    where `always`)."""

    moved: Callable | None = None
    logged: Callable | None = None
    amount: Any = None
    always: bool = False

    def world(self, session):
        """Return the true motion."""
        world = super().world(session)
        return world if self.moved is None else self.moved(world, self.protocol.random(session, 7), self.amount)

    def _changed(self, session, recording, wanted):
        if self.logged is None or not wanted:
            return recording
        return self.logged(recording, self.protocol.random(session, 8), self.amount)

    @cached_property
    def fit(self):
        """The recording to diagnose."""
        return self._changed("fit", self._moving("fit"), True)

    @cached_property
    def heldout(self):
        """Another recording."""
        return self._changed("heldout", self._moving("heldout"), True)

    @cached_property
    def static(self):
        """The recording at rest."""
        return self._changed("static", hidden.Case.static.func(self), self.always)
