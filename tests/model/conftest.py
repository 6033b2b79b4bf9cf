"""One thread for every test here: the networks are tiny, and results must not depend on the machine's cores."""

from __future__ import annotations

import torch

torch.set_num_threads(1)
