"""Estimation of a field and its gradient along a dead-reckoned track."""

from magrl.tracking.belief import probability_below, probability_within, steepest, surprise
from magrl.tracking.filter import (
    CURVATURE,
    DISTANCE_SCALE_KM,
    ELEMENT_SCALES,
    VARIANCE_FLOOR,
    FieldTrack,
    GradientPrior,
    GradientRelation,
    estimated_gradient,
    predict,
    relate,
    start,
    update,
)
from magrl.tracking.priors import (
    CURVATURE_NT,
    DIPOLE_STD_NT,
    curl_relation,
    dipole_prior,
    field_curvature,
)
from magrl.tracking.search import SEARCH_KM, VISITED, arrival_ellipse, unvisited, unvisited_yet, visit
from magrl.tracking.way import Way, way_to

__all__ = [
    "CURVATURE",
    "CURVATURE_NT",
    "DIPOLE_STD_NT",
    "DISTANCE_SCALE_KM",
    "ELEMENT_SCALES",
    "SEARCH_KM",
    "VARIANCE_FLOOR",
    "VISITED",
    "FieldTrack",
    "GradientPrior",
    "GradientRelation",
    "Way",
    "arrival_ellipse",
    "curl_relation",
    "dipole_prior",
    "estimated_gradient",
    "field_curvature",
    "predict",
    "probability_below",
    "probability_within",
    "relate",
    "start",
    "steepest",
    "surprise",
    "unvisited",
    "unvisited_yet",
    "update",
    "visit",
    "way_to",
]
