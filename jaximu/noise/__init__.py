"""The random errors of a sensor: processes (to simulate), and what data sheets say of them."""

from jaximu.noise.datasheet import convert, from_discrete, parse_quantity, to_discrete
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
    "BiasInstability",
    "BiasRepeatability",
    "FirstOrderGaussMarkov",
    "LinearSystem",
    "Noise",
    "Process",
    "Quantisation",
    "RandomConstant",
    "RandomWalk",
    "RateRamp",
    "SecondOrderGaussMarkov",
    "White",
    "convert",
    "from_discrete",
    "parse_quantity",
    "to_discrete",
]
