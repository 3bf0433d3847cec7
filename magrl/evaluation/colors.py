"""Colors of navigators, the same in every figure and in files for maps."""

from __future__ import annotations

from magrl.evaluation.navigators import NAVIGATOR_NAMES
from magrl.navigators import NAVIGATORS

_COLORS = ["#D55E00", "#0072B2", "#999999", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"]
_COLORS += ["#882255", "#332288", "#44AA99", "#999933", "#AA4499", "#6699CC", "#661100", "#117733"]

NAVIGATOR_COLORS = dict(zip(dict.fromkeys((*NAVIGATOR_NAMES, *NAVIGATORS)), _COLORS, strict=False))
"""Color of each navigator in every figure."""
