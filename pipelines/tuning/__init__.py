"""Tuning: weights fitted to a shot by its own samples, without a reference."""
