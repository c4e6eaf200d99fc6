"""The catalogue of effects, one file an effect (or a pair for both triads)."""

from jaximu.effects.base import Effect, Inner, SetupEffect
from jaximu.effects.catalogue import CATALOGUE, effect_title

__all__ = ["CATALOGUE", "Effect", "Inner", "SetupEffect", "effect_title"]
