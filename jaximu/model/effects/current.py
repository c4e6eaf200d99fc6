"""Current: the field of what flows in or beside the unit."""

from jaximu.model.effects.base import BiasEffect


class MagCurrent(BiasEffect):
    """An output in proportion to a current: by Biot and Savart's law the field of a wire at a fixed place."""

    name = "mag.current"
    formula = "c_i I"
    unit = "output/A"
    needs = ("current",)
    excited_by = "a current that changes"
    look_alikes = ("mag.temperature", "mag.hard_iron_step")
    source = "Biot and Savart's law; the current compensation of PX4 (CAL_MAGn_xCOMP) and ArduPilot (COMPASS_MOT_x)"
    typical = 2.0


EFFECTS = (MagCurrent,)
