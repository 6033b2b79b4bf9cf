"""arrays -> layers: the denoiser and everything it is made of, in plain PyTorch.

Files, EXR channels and command lines are unknown here: inputs are tensors by role name, outputs are `Layers`.
"""
