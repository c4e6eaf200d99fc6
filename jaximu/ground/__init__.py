"""What every room stands on: errors, units, numbers in words, rotations, the Earth, statistics, compiled programs."""

from typing import TYPE_CHECKING

from jaximu.ground.reexport import lazily

if TYPE_CHECKING:
    from jaximu.ground.atomic import atomic_write

__all__ = [
    "atomic_write",
]

__getattr__ = lazily(__name__)
