"""The catalogue of effects, one file an effect (or a pair for both triads)."""

from jaximu.effects.base import Effect
from jaximu.effects.quadratic import AccelQuadratic, GyroQuadratic

CATALOGUE: dict[str, type[Effect]] = {effect.name: effect for effect in (AccelQuadratic, GyroQuadratic)}

__all__ = ["CATALOGUE", "AccelQuadratic", "Effect", "GyroQuadratic"]
