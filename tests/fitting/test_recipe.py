"""Recipes in sections, and the page that lists their keys."""

import re

import pytest
from pydantic import BaseModel, ValidationError

from mmsynth.fitting.recipe import Recipe, keys_as_markdown
from mmsynth.packaged import data_folder

SECTIONS = {name: type(getattr(Recipe(), name)) for name in Recipe.model_fields}


def test_the_page_of_keys_is_the_models() -> None:
    """Made by: python -c 'from mmsynth.fitting.recipe import keys_as_markdown as k; print(k(), end="")'."""
    page = (data_folder("recipes") / "README.md").read_text(encoding="utf-8")
    assert page.split("<!-- keys -->\n")[1] == keys_as_markdown()


@pytest.mark.parametrize("section", SECTIONS)
def test_every_key_has_a_meaning_and_every_number_a_unit(section: str) -> None:
    model: type[BaseModel] = SECTIONS[section]
    counts = ("levels", "max_rows_log2", "hidden_width", "view_dependence")  # plain numbers, which have none
    for key, field in model.model_fields.items():
        assert field.description and field.description.rstrip().endswith("."), key
        if field.annotation in (int, float, float | None) and key not in counts:
            assert re.search(r"\[[^]]+\]", field.description), key


def test_changes_go_by_dotted_names() -> None:
    recipe = Recipe().with_changes({"surface.levels": 4, "poses.rig": "off"})
    assert (recipe.surface.levels, recipe.poses.rig) == (4, "off")
    assert recipe.with_changes({"surface.levels": Recipe().surface.levels, "poses.rig": "auto"}) == Recipe()
    for name in ("levels", "surface.nothing", "nothing.levels"):
        with pytest.raises(ValidationError):
            Recipe().with_changes({name: 4})
