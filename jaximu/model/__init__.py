"""The sensor model: what goes in and what comes out, conventions of other tools, effects, and noise."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.model.data_sheet import convert, from_discrete, parse_quantity, to_discrete
    from jaximu.model.noise import Noise
    from jaximu.model.noise_model import AxisNoise, NoiseModel
    from jaximu.model.processes import (
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
    from jaximu.model.state_space import LinearSystem

__all__ = [
    "AxisNoise",
    "BiasInstability",
    "BiasRepeatability",
    "FirstOrderGaussMarkov",
    "LinearSystem",
    "Noise",
    "NoiseModel",
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

__getattr__ = lazily(
    __name__,
    {
        "jaximu.model.data_sheet": "convert, from_discrete, parse_quantity, to_discrete",
        "jaximu.model.noise": "Noise",
        "jaximu.model.noise_model": "AxisNoise, NoiseModel",
        "jaximu.model.processes": (
            "BiasInstability, BiasRepeatability, FirstOrderGaussMarkov, Process, Quantisation, RandomConstant, "
            "RandomWalk, RateRamp, SecondOrderGaussMarkov, White"
        ),
        "jaximu.model.state_space": "LinearSystem",
    },
)
