"""The random errors of a sensor: processes (to simulate), what data sheets say of them, deviations of measured ones."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.noise.cleaning import Line
    from jaximu.noise.datasheet import convert, from_discrete, parse_quantity, to_discrete
    from jaximu.noise.deviations import Deviation, averaging_factors, deviation
    from jaximu.noise.identification import GaussMarkov, Identified, Term, WarmUp, identify
    from jaximu.noise.model import AxisNoise, NoiseModel
    from jaximu.noise.noise import Noise
    from jaximu.noise.processes import (
        BiasInstability,
        BiasRepeatability,
        FirstOrderGaussMarkov,
        Process,
        Quantisation,
        RandomConstant,
        RandomWalk,
        RateRamp,
        SecondOrderGaussMarkov,
        White,
    )
    from jaximu.noise.statespace import LinearSystem

__all__ = [
    "AxisNoise",
    "BiasInstability",
    "BiasRepeatability",
    "Deviation",
    "FirstOrderGaussMarkov",
    "GaussMarkov",
    "Identified",
    "Line",
    "LinearSystem",
    "Noise",
    "NoiseModel",
    "Process",
    "Quantisation",
    "RandomConstant",
    "RandomWalk",
    "RateRamp",
    "SecondOrderGaussMarkov",
    "Term",
    "WarmUp",
    "White",
    "averaging_factors",
    "convert",
    "deviation",
    "from_discrete",
    "identify",
    "parse_quantity",
    "to_discrete",
]

__getattr__ = lazily(__name__)
