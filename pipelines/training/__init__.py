"""Training: the data cache, the training loop, its curves and checkpoints."""
