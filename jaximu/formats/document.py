"""What is kept as a JSON document, sealed by its own hash so that a change can be seen."""

import hashlib
import json
import os
from abc import ABC, abstractmethod
from typing import Any

from jaximu.errors import NotPossibleError
from jaximu.formats.atomic import atomic_write

__all__ = ["Document", "digest"]


def digest(document: dict[str, Any]) -> str:
    """Return the SHA-256 of a document without its key `digest`, however its JSON is laid out."""
    content = {key: value for key, value in document.items() if key != "digest"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


class Document(ABC):
    """Something that is kept as one versioned JSON document."""

    @abstractmethod
    def document(self) -> dict[str, Any]:
        """Return what is kept, as JSON has it."""

    def text(self) -> str:
        """Return the document as text, with its hash as `digest`.

        Raises `NotPossibleError` instead of writing a number that is none.
        """
        document = self.document()
        try:
            return json.dumps(document | {"digest": digest(document)}, indent=1, allow_nan=False)
        except ValueError as error:
            kind = document["schema"].partition(".")[2].partition("/")[0]
            raise NotPossibleError(
                f"the {kind} holds numbers that are not finite and is not kept ({error})."
            ) from error

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the document, whole or not at all."""
        content = self.text()
        with atomic_write(path) as temporary:
            temporary.write_text(content + "\n", encoding="utf-8")
