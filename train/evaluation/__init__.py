"""How well teams explore: planners and policies over the same episodes, with bootstrap intervals, tables and plots."""

from imagine.train.evaluation.comparison import Comparison, evaluate
from imagine.train.evaluation.contenders import Contender, contender_of, named_contender
from imagine.train.evaluation.env import evaluation_env, shared_envs
from imagine.train.evaluation.episodes import run_episodes
from imagine.train.evaluation.plan import Plan
from imagine.train.evaluation.rows import bootstrap_interval, row

__all__ = [
    "Comparison",
    "Contender",
    "Plan",
    "bootstrap_interval",
    "contender_of",
    "evaluate",
    "evaluation_env",
    "named_contender",
    "row",
    "run_episodes",
    "shared_envs",
]
