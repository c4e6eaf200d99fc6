"""The one estimator: parameters by name, covariances, the solver, `fit`, and what a fit cannot determine."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.estimation.fitting import Fit

__all__ = [
    "Fit",
]

__getattr__ = lazily(__name__)
