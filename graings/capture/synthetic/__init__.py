"""Synthetic captures with ground truth: a small scene of ellipsoids for tests, and a suite of twelve moving scenes."""

from graings.capture.synthetic.catalogue import SUITE as SUITE
from graings.capture.synthetic.ellipsoids import Array as Array
from graings.capture.synthetic.ellipsoids import Body as Body
from graings.capture.synthetic.ellipsoids import SyntheticScene as SyntheticScene
from graings.capture.synthetic.ellipsoids import write_synthetic as write_synthetic
from graings.capture.synthetic.recipe import RECIPE_FILE as RECIPE_FILE
from graings.capture.synthetic.recipe import SceneRecipe as SceneRecipe
from graings.capture.synthetic.recipe import find_recipe as find_recipe
from graings.capture.synthetic.writing import synthesize as synthesize
