"""Weight files: what is saved is what is loaded, and what is not a weight file is refused by name."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from model import zoo
from tests.model.random_models import SMALL, random_network


@pytest.mark.parametrize("name", SMALL)
def test_saved_weights_load_as_the_same_network(name: str, tmp_path: Path) -> None:
    net = random_network(SMALL[name], 3, torch.float32)
    path = tmp_path / f"{name.replace(' ', '-')}.safetensors"
    zoo.save(net, path, {"description": name})
    weights = zoo.find(str(path))
    assert weights.config == SMALL[name]
    assert weights.info == {"description": name}
    for key, value in weights.load().state_dict().items():
        assert torch.equal(value, net.state_dict()[key].half().float())


def test_the_bytes_depend_on_the_weights_alone(tmp_path: Path) -> None:
    for name in ("a", "b"):
        zoo.save(random_network(SMALL["fast"], 1, torch.float32), tmp_path / f"{name}.safetensors", {"steps": 1})
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_saved_weights_have_the_permissions_of_any_other_file(tmp_path: Path) -> None:
    path = tmp_path / "shared.safetensors"
    net = random_network(SMALL["fast"], 1, torch.float32)
    before = os.umask(0o027)
    try:
        zoo.save(net, path, {})
        assert stat.S_IMODE(path.stat().st_mode) == 0o640
        path.chmod(0o664)
        zoo.save(net, path, {})
        assert stat.S_IMODE(path.stat().st_mode) == 0o664, "a file that is replaced stays as open as it was"
    finally:
        os.umask(before)


def test_what_is_not_ours_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no preset 'swift'; there are"):
        zoo.find("swift")
    with pytest.raises(ValueError, match="no such weight file"):
        zoo.find(str(tmp_path / "x.safetensors"))
    text = tmp_path / "text.safetensors"
    text.write_text("not weights")
    with pytest.raises(ValueError, match="not a safetensors file"):
        zoo.find(str(text))
    foreign = tmp_path / "foreign.safetensors"
    save_file({"x": torch.zeros(1)}, foreign)
    with pytest.raises(ValueError, match="not of lbmc"):
        zoo.find(str(foreign))
    for metadata, reason in (("{", "is broken"), ("[]", "is broken"), ("{}", "is broken"), ('{"format": 99}', "99")):
        save_file({"x": torch.zeros(1)}, foreign, {"lbmc": metadata})
        with pytest.raises(ValueError, match=rf"foreign\.safetensors: .*{reason}"):
            zoo.find(str(foreign))


def test_weights_of_another_network_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "old.safetensors"
    net = random_network(SMALL["fast"], 1, torch.float32)
    del net.generator
    zoo.save(net, path, {})
    with pytest.raises(ValueError, match=r"old\.safetensors: its weights are of another version"):
        zoo.find(str(path)).load()


def test_every_preset_that_ships_loads_and_is_small_enough() -> None:
    for weights in zoo.list_models():
        net = weights.load()
        assert all(torch.isfinite(value).all() for value in net.state_dict().values())
        assert weights.path.stat().st_size < 40e6
        assert weights.info["steps"] > 0
        assert weights.info["scores"]
