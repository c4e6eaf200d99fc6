"""Files in and out: `read_recording` finds the format from the content, `write_recording` from the suffix."""
