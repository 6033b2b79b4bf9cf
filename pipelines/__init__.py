"""The jobs behind the commands: denoise, pack, compare, render, train and what they share.

Importing the package itself costs nothing: no numpy, no torch, no EXR library.
"""

__version__ = "0.1.0"
