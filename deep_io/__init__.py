"""Files to arrays and back: deep and flat EXRs, roles, weighting, sequences. Never networks."""
