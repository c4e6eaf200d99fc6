"""What a column of a table is: by its name, by what wrote it, and by physics."""
