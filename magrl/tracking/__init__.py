"""Estimation of a field and its gradient along a dead-reckoned track."""

from magrl.tracking.belief import steepest, surprise
from magrl.tracking.decision import RANGE_KM, ArrivalDecision, approach, arrival_decision
from magrl.tracking.filter import (
    CURVATURE,
    DISTANCE_SCALE_KM,
    ELEMENT_PERIODS,
    ELEMENT_SCALES,
    VARIANCE_FLOOR,
    FieldTrack,
    GradientPrior,
    GradientRelation,
    estimated_field,
    estimated_gradient,
    predict,
    relate,
    start,
    update,
)
from magrl.tracking.posterior import WayPosterior, way_posterior
from magrl.tracking.priors import (
    curl_relation,
    dipole_prior,
    field_curvature,
)
from magrl.tracking.search import (
    VISITED,
    arrival_weights,
    unvisited,
    unvisited_yet,
    visit,
)
from magrl.tracking.track import aim, displacement_of, read, related
from magrl.tracking.way import Way, way_to

__all__ = [
    "CURVATURE",
    "DISTANCE_SCALE_KM",
    "ELEMENT_PERIODS",
    "ELEMENT_SCALES",
    "RANGE_KM",
    "VARIANCE_FLOOR",
    "VISITED",
    "ArrivalDecision",
    "FieldTrack",
    "GradientPrior",
    "GradientRelation",
    "Way",
    "WayPosterior",
    "aim",
    "approach",
    "arrival_decision",
    "arrival_weights",
    "curl_relation",
    "dipole_prior",
    "displacement_of",
    "estimated_field",
    "estimated_gradient",
    "field_curvature",
    "predict",
    "read",
    "relate",
    "related",
    "start",
    "steepest",
    "surprise",
    "unvisited",
    "unvisited_yet",
    "update",
    "visit",
    "way_posterior",
    "way_to",
]
