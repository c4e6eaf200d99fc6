"""Temperature: what bias and scale do over it, from recordings at rest; what they can tell; other tools' parameters."""
