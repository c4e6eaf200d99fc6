"""Size effect: the three accelerometers do not sit at one point."""

import jax.numpy as jnp

from jaximu.model.effects.base import Effect
from jaximu.model.effects.lever_arm import LEVER_RECOVERY, lever_acceleration


class AccelSizeEffect(Effect):
    """Each axis senses the force at its own place r_i, given from the point that `specific_force` belongs to.

    Coefficients: r_x, r_y, r_z one after the other, three components each. Its common part is the lever arm.

    The sign is that of positions: the part is added to the output, and correction subtracts it. PSINS' `sysclbt` and
    `imuclbt` subtract the same product of the same r, so arms found by either agree. A recording that PSINS *simulates*
    with `imuclbt` has been corrected although it was ideal: in it the arms are minus those that were passed.
    """

    name = "accel.size_effect"
    formula = "e_i · (ω×(ω×r_i) + ω̇×r_i)"
    unit = "m"
    size = 9
    scope = "device"
    needs = ("angular_rate", "angular_acceleration")
    excited_by = "rotation about several axes, quick enough for ω²r"
    look_alikes = ("accel.lever_arm",)
    source = "rigid-body kinematics; Rehder et al., ICRA 2016 (kalibr's size effect)"
    typical = 3e-3
    refers_to = "input"
    recovery = LEVER_RECOVERY

    def term(self, stimulus):
        arms = self.coefficients.reshape(3, 3)
        motion = self.needed(stimulus)
        return jnp.stack([lever_acceleration(arms[i], *motion)[..., i] for i in range(3)], axis=-1)


EFFECTS = (AccelSizeEffect,)
