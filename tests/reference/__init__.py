"""Slow twins: each kernel again, written as its definition reads, in float64 and without tricks."""
