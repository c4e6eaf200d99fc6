"""Recordings at rest over temperature, asked for all that changes a unit's output there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import numpy as np

from jaximu.calibration import calibrate_thermal
from jaximu.calibration.thermal_shapes import ThermalShapes
from jaximu.calibration.thermal_terms import BESIDE, HISTORY, RATES
from jaximu.data import RestBlocks
from jaximu.data.rest_blocks import rest_blocks
from jaximu.data.resting import Resting
from jaximu.diagnosis.diagnosis import Diagnosis, Examination, examine
from jaximu.diagnosis.experiment import Experiment
from jaximu.diagnosis.learned import left_out
from jaximu.ground.errors import NotPossibleError
from jaximu.mistakes import inspect
from jaximu.model.effects import Effect
from jaximu.model.noise_model import NoiseModel
from jaximu.model.sensor import Imu
from jaximu.noise.at_rest import noise_of
from jaximu.recordings.recording import Recording, recordings_of

_BLOCKS = 120
_NAMED = 3  # effects that can be named one by one
_CYCLE = (
    "Record a cycle: the same temperatures up and down, then again at another rate; what depends on time or on "
    "power-on does not come back with the temperature, and what depends on its rate changes sign."
)


def diagnose_thermal(
    recordings: Recording | Sequence[Recording],
    *,
    static: Recording | NoiseModel | None = None,
    heldout: Recording | Sequence[Recording] | None = None,
    level: float = 0.05,
) -> Diagnosis:
    """Ask recordings at rest over temperature for everything that changes a unit's output there, and name it.

    The model is that which `calibrate_thermal` selects. Where it is a few effects, every effect is asked of a unit of
    constant bias. Else bias may be any smooth function of temperature beforehand; the lag, hysteresis and rates that
    were selected are in the model, and what goes beyond is asked: warm-up, drift, steps. The gain is measured on whole
    ways of the temperature left out in turn. In one way of the temperature a lag is not observable then, and the
    suggestion asks for a cycle.

    **Arguments:** as for [`jaximu.calibration.calibrate_thermal`]; `heldout`: other such recordings of the unit, to
    measure the gain on. Raises what that raises, and `NotPossibleError` without a gyroscope.
    """
    logs, noise = recordings_of(recordings), noise_of(static)
    if any(recording.gyroscope is None for recording in logs):
        raise NotPossibleError("a diagnosis needs accelerometer and gyroscope.")
    thermal = calibrate_thermal(logs, static=noise)
    start = jax.tree.map(np.asarray, thermal.calibration.imu.with_effects())
    calibration = thermal.calibration.of_numbers(lambda name: name.effect is None, imu=start)
    known = thermal.noise if noise is None else noise
    blocks = _apart(_coarse(logs), thermal.jumps)
    findings = [finding for recording in logs for finding in inspect(recording)]
    held = None if heldout is None else _coarse(recordings_of(heldout))
    notes = [*thermal.blocks.notes, *known.notes, *(note for note in thermal.notes if "jumps by" in note)]
    chosen = [effect for triad in thermal.calibration.triads().values() for effect in triad.effects]
    beyond = [effect for effect in chosen if effect.plain in (*RATES, *HISTORY, *BESIDE)]

    def asked(smooth: bool, taken: Sequence[Effect]) -> Diagnosis:
        other = None if held is None else _remade(held, start, smooth)
        beforehand = ["bias was allowed to be any smooth function of temperature; what is named goes beyond that."]
        sentences = (*dict.fromkeys(notes), *(beforehand if smooth else []))
        about = calibration, known, _remade(blocks, start, smooth), other, tuple(findings), sentences, level
        return examine(Examination(*about, trusted=noise is None, taken=tuple(taken), measured=left_out))

    wanted = {effect.name for effect in beyond if effect.cause}
    first = diagnosis = asked(False, ()) if len(chosen) <= _NAMED else None
    if first is None or first.verdict == "unexplained" or (first.verdict == "effects" and _misses(first, wanted)):
        diagnosis = asked(True, beyond)
        hides = first is not None and first.verdict == "effects" and _misses(diagnosis, wanted)
        diagnosis = first if hides else diagnosis  # any smooth function may hide a cause
    assert diagnosis is not None
    if "thermal_lag" not in thermal.identifiability.told:  # temperature, its rate and time go together
        diagnosis = replace(diagnosis, suggestion=f"{diagnosis.suggestion} {_CYCLE}".strip())
    return diagnosis


def _remade(blocks: RestBlocks, start: Imu, smooth: bool) -> Callable[[NoiseModel], Experiment]:
    """Return what makes the blocks an experiment about a unit with a noise model."""
    curves = ThermalShapes(blocks, start.accelerometer.temperature_reference).smooth()
    return lambda noise: Experiment(Resting(blocks, noise, curves, smooth), start)


def _misses(diagnosis: Diagnosis, wanted: set[str]) -> bool:
    """Whether effects that were selected are neither named nor rivals of those that are."""
    return not wanted <= {name for named in diagnosis.named for name in (named.name, *named.rivals)}


def _apart(blocks: RestBlocks, jumps: Sequence[tuple[int, float]]) -> RestBlocks:
    """Return blocks with a rest of its own after each jump (recording, s); the block in which it lies is left out."""
    for log, time in jumps:
        slack = 1e-6 * blocks.duration
        blocks = blocks.only((blocks.log != log) | (blocks.stop <= time + slack) | (blocks.start >= time - slack))
        later = np.flatnonzero((blocks.log == log) & (blocks.start >= time - slack))
        if len(later) and blocks.level[later[0]] == blocks.level[max(later[0] - 1, 0)]:
            blocks = blocks.parted([int(later[0])])
    return blocks


def _coarse(recordings: Sequence[Recording]) -> RestBlocks:
    span = sum(float(np.ptp(recording.accelerometer.time)) for recording in recordings)
    rate = min(recording.accelerometer.rate for recording in recordings)
    return rest_blocks(recordings, max(span / _BLOCKS, 2 / rate))
