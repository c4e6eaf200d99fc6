"""What a fitted model gets wrong, why, and what extending it gains."""

from jaximu.diagnosis.checks import Check
from jaximu.diagnosis.diagnosis import Diagnosis, Named, diagnose
from jaximu.diagnosis.preflight import Finding, inspect
from jaximu.diagnosis.twin import twin_of

__all__ = ["Check", "Diagnosis", "Finding", "Named", "diagnose", "inspect", "twin_of"]
