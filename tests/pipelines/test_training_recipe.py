"""Recipes: read from JSON and from words, refused by the field's name, and what they say of each step."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from deep_io.errors import InputError, UsageError
from model.losses import LossWeights
from pipelines.training.recipe import Augmentation, Recipe, changed, differences, from_dict, read_recipe

FINISH = LossWeights(smape=1.0, relative=0.1, pooled=())


def test_a_recipe_survives_json() -> None:
    recipe = Recipe(steps=7, samples=((1, 0.5), (32, 1.5)), finish=0.25, finish_loss=FINISH,
                    augmentation=Augmentation(firefly_gain=(2.0, 6.0)))
    assert from_dict(json.loads(json.dumps(recipe.to_dict())), "here") == recipe
    assert from_dict({}, "here") == Recipe()
    assert from_dict({"learning_rate": 1}, "here").learning_rate == 1.0


def test_words_set_fields_at_any_depth() -> None:
    recipe = changed(Recipe(), ["warmup=3", "loss.smape=1", "samples=[[4,1]]", "augmentation.symmetries=false",
                                "finish=0.5", "finish_loss.smape=0.75", "loss.pooled=[]"])
    assert recipe.warmup == 3
    assert recipe.loss == LossWeights(smape=1.0, pooled=())
    assert recipe.samples == ((4, 1.0),)
    assert not recipe.augmentation.symmetries
    assert recipe.finish_loss == LossWeights(smape=0.75)


@pytest.mark.parametrize(
    ("word", "named"),
    [
        ("warmup", "write NAME=VALUE"),
        ("warmpu=3", "no field warmpu; there are steps, "),
        ("loss.sharpness=3", "no field loss.sharpness; there are smape"),
        ("loss.smape.x=3", "a recipe has no loss.smape.x"),
        ("nothing.x=3", "a recipe has no nothing.x"),
        ("warmup=soon", "'soon' is not a JSON value"),
        ("warmup=2.5", "warmup must be a whole number, not 2.5"),
        ("bfloat16=1", "bfloat16 must be bool, not 1"),
        ("samples=8", "samples must be a list, not 8"),
        ("samples=[[8]]", r"samples must be a list of 2, not \[8\]"),
        ("samples=[[0,1]]", "samples must be pairs of a number from 1 and how often"),
        ("layers=[[6,1]]", "layers must be pairs of a number from 1 to 5"),
        ("layers=[[2,0]]", "layers must be pairs"),
        ("crop=16", "crop is 16; it must be at least 32"),
        ("average=1.5", "average is 1.5; it must be between 0 and 1"),
        ("learning_rate=0", "learning_rate is 0.0; it must be above 0"),
        ("finish=0.5", "no finish_loss"),
        ("loss.pooled=[[256,1]]", "pooled cells must be 1 to 128 pixels"),
        ("augmentation.firefly_gain=[2,1]", "firefly_gain must rise"),
        ("loss=3", "loss must be an object of smape"),
    ],
)
def test_words_that_make_no_recipe_are_refused_by_name(word: str, named: str) -> None:
    with pytest.raises(UsageError, match=f"^--set {word.split('=')[0]}.*{named}"):
        changed(Recipe(), [word])


def test_files_that_hold_no_recipe_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    with pytest.raises(InputError, match="r.json: not a recipe: .*No such file"):
        read_recipe(path)
    for text in ("{", "[1]"):
        path.write_text(text)
        with pytest.raises(InputError, match="r.json: not a recipe"):
            read_recipe(path)
    path.write_text('{"stesp": 5}')
    with pytest.raises(UsageError, match="r.json: no field stesp"):
        read_recipe(path)


def test_the_loss_changes_for_the_finish() -> None:
    recipe = Recipe(steps=100, finish=0.25, finish_loss=FINISH)
    assert [recipe.loss_at(step) is FINISH for step in (0, 74, 75, 99)] == [False, False, True, True]
    assert Recipe(steps=10).loss_at(9) == LossWeights()


def test_differences_name_the_fields() -> None:
    one = Recipe()
    other = dataclasses.replace(one, seed=9, loss=LossWeights(smape=0.4))
    assert list(differences(one.to_dict(), other.to_dict())) == ["loss.smape", "seed"]
    assert not list(differences(one.to_dict(), one.to_dict()))
