"""The catalogue of effects, one file an effect (or a pair for both triads)."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.model.effects.base import Effect, Inner, SetupEffect
    from jaximu.model.effects.catalogue import CATALOGUE, register, registered

__all__ = [
    "CATALOGUE",
    "Effect",
    "Inner",
    "SetupEffect",
    "register",
    "registered",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.model.effects.base": "Effect, Inner, SetupEffect",
        "jaximu.model.effects.catalogue": "CATALOGUE, register, registered",
    },
)
