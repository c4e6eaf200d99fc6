"""`Noise`: all random errors of one triad, from a data sheet or by hand, as theory and as samples."""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from jaximu.ground.array_types import FloatArray
from jaximu.ground.errors import InputError
from jaximu.ground.precision import require_float64
from jaximu.model import processes as kinds
from jaximu.model.data_sheet import (
    DATASHEET_UNITS,
    SI_UNITS,
    TERM_NAMES,
    convert,
    from_discrete,
    parse_quantity,
    parse_unit,
    to_discrete,
)
from jaximu.model.noise_model import AxisNoise
from jaximu.model.processes import FirstOrderGaussMarkov, Process, White
from jaximu.model.state_space import BLOCK, LinearSystem, combine, linear_system, run

Generators = list[np.random.Generator]
"""A stream of draws for every unit and axis, in their order."""

FIGURE_TERMS = {
    "white": "N",
    "bias_instability": "B",
    "rate_random_walk": "K",
    "quantisation": "Q",
    "rate_ramp": "R",
    "repeatability": "B",
    "bias": "B",
}
"""The term in whose unit `Noise.from_datasheet` takes a figure."""


@dataclass(frozen=True)
class Noise:
    """The random errors of a triad: independent processes, in the SI unit of `quantity`, alike or by axis (..., 3)."""

    processes: tuple[Process, ...] = ()
    quantity: str = "angular_rate"  # or "specific_force", "magnetic_field"

    def __post_init__(self) -> None:
        if self.quantity not in SI_UNITS:
            raise InputError(f"noise belongs to one of {', '.join(SI_UNITS)}, not to {self.quantity!r}.")

    @classmethod
    def from_datasheet(
        cls,
        quantity: str,
        *,
        white: str | float | None = None,
        density: str | None = None,
        bias_instability: str | float | None = None,
        bias_instability_is: str | None = None,
        rate_random_walk: str | float | None = None,
        quantisation: str | float | None = None,
        rate_ramp: str | float | None = None,
        repeatability: str | float | None = None,
        bias: str | float | None = None,
        rate: float | None = None,
    ) -> Noise:
        """Return the noise that a data sheet states. Figures are text with a unit, or numbers in SI (`SI_UNITS`).

        **Arguments:**

        - `quantity`: `"angular_rate"` (gyroscope), `"specific_force"` (accelerometer) or `"magnetic_field"`.
        - `white`: N, as a random walk ("0.66 deg/sqrt(h)"), as a density ("100 ug/sqrt(Hz)"), or as a standard
          deviation per sample ("0.05 deg/s"), which needs `rate`.
        - `density`: must be said where `white` is per √Hz: `"one-sided"` (spectrum analysers and most sheets: the power
          of both signs of frequency added up, N = density/√2) or `"two-sided"` (N itself).
        - `bias_instability`: in-run bias stability; `bias_instability_is` must say whether the sheet means `"B"` or
          the minimum of the Allan deviation, `"allan-minimum"`, which is 0.664 B.
        - `rate_random_walk`: K; `quantisation`: Q; `rate_ramp`: R.
        - `repeatability`: standard deviation of the bias from power-on to power-on; `bias`: from unit to unit.
        - `rate`: sample rate (Hz) that a discrete `white` belongs to.

        Raises `InputError` for a wrong unit, a negative figure, or what is left unsaid.
        """
        units = SI_UNITS[cls((), quantity).quantity]  # which the constructor checks
        processes: list[Process] = [] if white is None else [kinds.White(_white(white, units, density, rate))]
        if bias_instability is not None:
            value = parse_quantity(bias_instability, units["B"], "bias_instability")
            if bias_instability_is not in ("B", "allan-minimum"):
                raise InputError(
                    "bias_instability_is must say what the sheet means by its bias (in-)stability: 'B', or "
                    "'allan-minimum' for the lowest point of the Allan deviation, which is 0.664 B."
                )
            share = 1.0 if bias_instability_is == "B" else np.sqrt(kinds.FLICKER_VARIANCE)
            processes.append(kinds.BiasInstability(value / share))
        for name, kind, figure in (
            ("rate_random_walk", kinds.RandomWalk, rate_random_walk),
            ("quantisation", kinds.Quantisation, quantisation),
            ("rate_ramp", kinds.RateRamp, rate_ramp),
            ("repeatability", kinds.BiasRepeatability, repeatability),
            ("bias", kinds.RandomConstant, bias),
        ):
            if figure is not None:
                processes.append(kind(parse_quantity(figure, units[FIGURE_TERMS[name]], name)))
        return cls(tuple(processes), quantity)

    def allan_deviation(self, tau: ArrayLike) -> FloatArray:
        """Return the Allan deviation in theory at averaging times (n,), s: variances of the processes added up."""
        return np.sqrt(sum((process.allan_variance(tau) for process in self.processes), start=np.zeros(np.shape(tau))))

    def squares(self) -> dict[str, FloatArray]:
        """Return the squares (3,) of the sizes of the terms there are, by letter, SI."""
        squares: dict[str, FloatArray] = {}
        for process in self.processes:
            squares[process.letter] = squares.get(process.letter, np.zeros(3)) + process.size[..., 0] ** 2
        return squares

    def figures(self, rate: float | None = None) -> list[dict[str, object]]:
        """Return each term as a data sheet would: continuous in SI and in the customary unit; discrete where it is one.

        One dictionary a term: `term`, `meaning`, `value` and `unit` (continuous, SI), `customary` and
        `customary_unit`, and with `rate` (Hz) `per_sample` (the discrete standard deviation, SI) for N and K.
        """
        rows: list[dict[str, object]] = []
        for process in self.processes:
            if not process.letter:
                continue
            value = np.asarray(getattr(process, process.letter))
            unit, customary = (table[self.quantity][process.letter] for table in (SI_UNITS, DATASHEET_UNITS))
            row: dict[str, object] = {
                "term": process.letter,
                "meaning": TERM_NAMES[process.letter],
                "value": value.tolist(),
                "unit": unit,
                "customary": np.asarray(convert(value, unit, customary)).tolist(),
                "customary_unit": customary,
            }
            if rate is not None and process.letter in ("N", "K"):
                row["per_sample"] = to_discrete(process.letter, value, rate).tolist()
            rows.append(row)
        return rows

    def stream(self, rate: float, seed: int | Sequence[int] = 0, power_on: int = 0, shape: tuple[int, ...] = ()):
        """Return a source of samples at `rate` (Hz): see `NoiseStream`."""
        return NoiseStream(self, rate, seed, power_on, shape)

    def sample(
        self, samples: int, rate: float, seed: int | Sequence[int] = 0, power_on: int = 0, shape: tuple[int, ...] = ()
    ) -> FloatArray:
        """Return samples (*shape, samples, 3) in SI at `rate` (Hz): the same arguments give the same samples.

        `shape` are units, each with its own draws and, where a process's parameters have leading axes, its own
        parameters. `power_on` counts recordings of the same unit: what belongs to the unit stays, the rest is new.
        """
        return self.stream(rate, seed, power_on, shape).take(samples)


def _white(white: str | float, units: dict[str, str], density: str | None, rate: float | None) -> float:
    text = str(white)
    unit = text.lstrip("+-.0123456789eE ") if isinstance(white, str) else ""
    if unit and parse_unit(unit).dimension == parse_unit(units["B"]).dimension:
        if rate is None:
            raise InputError(f"white: {text!r} is a standard deviation per sample; give the rate it belongs to (Hz).")
        return float(from_discrete("N", parse_quantity(text, units["B"], "white"), rate))
    value = parse_quantity(white, units["N"], "white")
    if "Hz" not in unit:
        return value
    if density not in ("one-sided", "two-sided"):
        raise InputError(
            f"density must say whether {text!r} is 'one-sided' (N is that over √2) or 'two-sided' (N itself)."
        )
    return value / np.sqrt(2) if density == "one-sided" else value


class NoiseStream:
    """A triad's noise, block after block: `take(n)` returns the next n samples (*shape, n, 3).

    Draws come from NumPy, a stream of its own for every unit, process and axis, so that a sample depends neither on the
    lengths taken nor on which other processes there are. Takes other than the last one must be of a multiple of 64
    samples.
    """

    def __init__(self, noise: Noise, rate: float, seed: int | Sequence[int], power_on: int, shape: tuple[int, ...]):
        require_float64()
        if not rate > 0:
            raise InputError(f"the sample rate must be positive, found {rate}.")
        self.shape = shape
        self._still: list[tuple[FloatArray, Generators]] = []
        self._moving: list[tuple[LinearSystem, Generators]] = []
        starts: list[FloatArray] = []
        root = list(seed) if isinstance(seed, Sequence) else [seed]
        counts = Counter[str]()
        for process in noise.processes:
            kind = type(process).__name__
            counts[kind] += 1
            key = zlib.crc32(f"{noise.quantity}.{kind}.{counts[kind]}".encode())
            period = 0 if process.per_unit else power_on + 1
            system = linear_system(*vars(process.system(1 / rate)).values(), leading=(*shape, 3))
            generators = [np.random.default_rng([*root, key, period, *axis]) for axis in np.ndindex(*shape, 3)]
            if system.transition.shape[-1] == 0:
                self._still.append((np.asarray(system.through), generators))
                continue
            initial = np.stack([generator.standard_normal(system.root.shape[-1]) for generator in generators])
            initial = initial.reshape(*shape, 3, -1)
            starts.append(np.asarray(system.start) + np.einsum("...sr,...r->...s", system.root, initial))
            self._moving.append((system, generators))
        self._blocks = combine([system for system, _ in self._moving]).blocked() if starts else None
        self._state = np.concatenate(starts, axis=-1) if starts else np.zeros(0)
        self._ended = False

    def take(self, samples: int) -> FloatArray:
        """Return the next samples (*shape, samples, 3), SI."""
        if self._ended:
            raise ValueError("the stream has ended: an earlier take was not of a multiple of the block")
        self._ended = samples % BLOCK != 0
        padded = -(-samples // BLOCK) * BLOCK
        total = np.zeros((*self.shape, 3, padded))
        for through, generators in self._still:
            total += (through[..., None] * self._draw(generators, through.shape[-1], padded)).sum(axis=-2)
        if self._blocks is not None:
            draws = [self._draw(generators, system.drive.shape[-1], padded) for system, generators in self._moving]
            output, self._state = run(self._blocks, self._state, np.concatenate(draws, axis=-2))
            total += output
        return np.moveaxis(total, -2, -1)[..., :samples, :]

    def _draw(self, generators: Generators, inputs: int, samples: int) -> FloatArray:
        """Unit normals (*shape, 3, inputs, samples), by as many threads as there are processors."""
        draws = np.empty((len(generators), inputs, samples))
        if inputs == 1:
            list(_threads().map(lambda generator, out: generator.standard_normal(out=out[0]), generators, draws))
        elif inputs:
            for generator, out in zip(generators, draws, strict=True):
                out[:] = generator.standard_normal((samples, inputs)).T  # sample by sample: no take may change the next
        return draws.reshape(*self.shape, 3, inputs, samples)


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="jaximu-noise")


def drawn_noise(noise: AxisNoise, count: int, rate: float, seed: Sequence[int]) -> FloatArray:
    """Return that many samples (n, 3), SI, of a triad's white noise and slow bias, at a rate in Hz."""
    processes = [White(np.sqrt(noise.white))]
    processes += [
        FirstOrderGaussMarkov.of(np.sqrt(variance), time)
        for variance, time in zip(noise.variance.T, noise.correlation_time, strict=True)
        if variance.any()
    ]
    return np.asarray(Noise(tuple(processes), "specific_force").sample(count, rate, list(seed)))
