"""Every option of a run: its sections, the whole, and presets."""

from graings.config.optimization import DensityConfig as DensityConfig
from graings.config.optimization import EvaluationConfig as EvaluationConfig
from graings.config.optimization import GuardConfig as GuardConfig
from graings.config.optimization import RatesConfig as RatesConfig
from graings.config.overrides import make_config as make_config
from graings.config.overrides import merged as merged
from graings.config.overrides import options as options
from graings.config.overrides import restored as restored
from graings.config.plan_options import Part as Part
from graings.config.plan_options import PlanConfig as PlanConfig
from graings.config.presets import PAPER_ITERATIONS as PAPER_ITERATIONS
from graings.config.presets import PRESETS as PRESETS
from graings.config.sections import CaptureConfig as CaptureConfig
from graings.config.sections import ConfigSection as ConfigSection
from graings.config.sections import InitConfig as InitConfig
from graings.config.sections import LossConfig as LossConfig
from graings.config.sections import SceneConfig as SceneConfig
from graings.config.train_config import TrainConfig as TrainConfig
