"""What is named in English: an effect, a mistake in the data, a kind of noise."""

from jaximu.mistakes.preparation import MISTAKES
from jaximu.model.data_sheet import NOISE_KINDS
from jaximu.model.effects import CATALOGUE


def effect_title(name: str) -> str:
    """Return an effect, a mistake in the data or a kind of noise in English, with its name after it."""
    if name in CATALOGUE:
        return CATALOGUE[name].title
    others = MISTAKES | NOISE_KINDS
    return f"{others[name]} ({name})" if name in others else name
