"""Planners that act through a model: one parent, and one method per planner."""

from torchrl_vjepa.planners.base import Plan, Planner
from torchrl_vjepa.planners.cem import CEM
from torchrl_vjepa.planners.env_objective import EnvObjective
from torchrl_vjepa.planners.exhaustive import ExhaustiveSearch
from torchrl_vjepa.planners.gradient import GradientMPC
from torchrl_vjepa.planners.mppi import MPPI
from torchrl_vjepa.planners.proposal import Proposal, ProposalFamily
from torchrl_vjepa.planners.random_shooting import RandomShooting
from torchrl_vjepa.planners.sampling import SamplingPlanner
from torchrl_vjepa.planners.tree_search import TreeSearch

__all__ = [
    "CEM",
    "MPPI",
    "EnvObjective",
    "ExhaustiveSearch",
    "GradientMPC",
    "Plan",
    "Planner",
    "Proposal",
    "ProposalFamily",
    "RandomShooting",
    "SamplingPlanner",
    "TreeSearch",
]
