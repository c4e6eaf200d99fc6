"""`History`: what a Kalman filter knew of a unit, and when."""

from __future__ import annotations

from dataclasses import dataclass

from jaximu.estimation.problem import Name
from jaximu.ground.array_types import BoolArray, FloatArray


@dataclass(frozen=True)
class History:
    """What the filter knew when. time (N,): s, at the end of each interval; rest (N,).

    names: of the free numbers; values, sigmas (N, p) of them, in their own units. drift, drift_sigma (N, 6): of rate
    (rad/s) and force (m/s²), smoothed. innovations (N,): normalised, squared, of `freedom` (N,) degrees. earth: places
    of the Earth's rotation among the numbers.
    """

    time: FloatArray
    rest: BoolArray
    names: tuple[Name, ...]
    values: FloatArray
    sigmas: FloatArray
    drift: FloatArray
    drift_sigma: FloatArray
    innovations: FloatArray
    freedom: FloatArray
    earth: tuple[int, ...]

    def converged(self, place: int) -> float | None:
        """Return after how many seconds a number's uncertainty came within twice its last; None if it never halved."""
        sigma = self.sigmas[:, place]
        if sigma[-1] > sigma[0] / 2:
            return None
        return float(self.time[(sigma <= 2 * sigma[-1]).argmax()] - self.time[0])
