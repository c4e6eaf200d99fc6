"""What a fitted model gets wrong, why, and what extending it gains."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.diagnosis.attitude import diagnose_against_attitude
    from jaximu.diagnosis.attribution import Attributed, Attribution, attribute, places_of
    from jaximu.diagnosis.checking import check
    from jaximu.diagnosis.checks import Check
    from jaximu.diagnosis.common_drift import COMMON_DRIFT, CommonDrift
    from jaximu.diagnosis.diagnosis import Diagnosis, Named, diagnose, twin_of
    from jaximu.diagnosis.experiment import KnownEffect
    from jaximu.diagnosis.magnetometer import (
        MagneticDiagnosis,
        MagneticShift,
        check_magnetometer,
        diagnose_magnetometer,
    )
    from jaximu.diagnosis.thermal import diagnose_thermal
    from jaximu.diagnosis.turntable import diagnose_turntable
    from jaximu.diagnosis.validity import Validity

__all__ = [
    "COMMON_DRIFT",
    "Attributed",
    "Attribution",
    "Check",
    "CommonDrift",
    "Diagnosis",
    "KnownEffect",
    "MagneticDiagnosis",
    "MagneticShift",
    "Named",
    "Validity",
    "attribute",
    "check",
    "check_magnetometer",
    "diagnose",
    "diagnose_against_attitude",
    "diagnose_magnetometer",
    "diagnose_thermal",
    "diagnose_turntable",
    "places_of",
    "twin_of",
]

__getattr__ = lazily(
    __name__,
    {
        "jaximu.diagnosis.attitude": "diagnose_against_attitude",
        "jaximu.diagnosis.attribution": "Attributed, Attribution, attribute, places_of",
        "jaximu.diagnosis.checking": "check",
        "jaximu.diagnosis.checks": "Check",
        "jaximu.diagnosis.common_drift": "COMMON_DRIFT, CommonDrift",
        "jaximu.diagnosis.diagnosis": "Diagnosis, Named, diagnose, twin_of",
        "jaximu.diagnosis.experiment": "KnownEffect",
        "jaximu.diagnosis.magnetometer": "MagneticDiagnosis, MagneticShift, check_magnetometer, diagnose_magnetometer",
        "jaximu.diagnosis.thermal": "diagnose_thermal",
        "jaximu.diagnosis.turntable": "diagnose_turntable",
        "jaximu.diagnosis.validity": "Validity",
    },
)
