"""Kinds of measurement: what recordings say about a unit, one file a kind."""
