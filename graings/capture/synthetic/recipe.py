"""SceneRecipe: which synthetic scene a job is to draw, as a folder with one file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from pydantic import Field, ValidationError

from graings.capture.synthetic.catalogue import SUITE
from graings.document import Document, first_problem
from graings.errors import CaptureError

RECIPE_FILE: Final = "scene.json"


class SceneRecipe(Document):
    """A scene of the suite; the defaults are those of the demo, which a draft learns in a minute or two."""

    scene: str = Field(json_schema_extra={"enum": [scene.name for scene in SUITE]}, description="Name of the scene.")
    size: int = Field(200, ge=16, le=1024, description="Width and height of the images in px.")
    views: int = Field(150, ge=1, le=1000, description="Training images; held-out views are added.")
    seed: int = Field(0, ge=0, lt=2**31, description="Of cameras and patterns.")


def find_recipe(folder: Path) -> SceneRecipe | None:
    """The recipe in `folder`; None unless it is the only file. Raises `CaptureError` where it does not fit."""
    file = folder / RECIPE_FILE
    if not file.is_file() or any(path != file for path in folder.iterdir()):
        return None
    known = f"An example: {json.dumps(SceneRecipe(scene=SUITE[0].name).to_json())}."
    try:
        recipe = SceneRecipe.model_validate_json(file.read_bytes())
    except ValidationError as error:
        raise CaptureError(first_problem(error), file=RECIPE_FILE, remedy=known) from error
    if recipe.scene not in (names := [scene.name for scene in SUITE]):
        raise CaptureError(
            f"there is no scene {recipe.scene!r}", file=RECIPE_FILE, remedy=f"Choose one of {', '.join(names)}."
        )
    return recipe
