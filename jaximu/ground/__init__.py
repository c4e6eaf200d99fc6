"""What every room stands on: errors, units, numbers in words, rotations, the Earth, statistics, compiled programs."""
