"""Flights of tables and figures: frozen trips in random regions, navigators that know the accuracy of their sensors."""

from __future__ import annotations

import glob
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from magrl.errors import Conditions
from magrl.evaluation import Flight, Sheet, episode_measures, summarize
from magrl.evaluation.episodes import first_episode_mask
from magrl.evaluation.tables import about, mean_of_runs
from magrl.evaluation.tracks import TRACKS, Track
from magrl.files import check_writable, write_with
from magrl.geodesy import geodesic, move_place, polar
from magrl.navigators.names import named
from magrl.sensor_std import Noise

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from pandas import DataFrame
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from tensordict import TensorDictBase
from torch import Tensor

Errors, Measures = Noise | Conditions, Mapping[str, Tensor]
Spec = str | Mapping[str, Any]
"""Navigator: a text, as recipes/evaluate.py takes it, or a ``name`` with options of its own."""
MEASURES = ("success_rate", "spl")
"""Measures in a cell of a table."""
SHARES = {"success_rate": "success", "false_arrival_rate": "false_arrival"}
"""Measures that are shares of episodes, and what they count."""
PLACED = ("geodesic",)
"""Navigators that read no elements."""
ABOUT = ("navigator", "trained on", "start", "map", "elements at the destination")
"""First columns of a table: what each navigator is, and what it knows."""
COLORS = 256
"""Most colors of a picture."""
OWN_MODEL = "model"
"""``target_std`` in a file, where the elements of the destination are from the vehicle's own model."""


class Table(NamedTuple):
    """A table of the documentation, and the episodes that it summarizes."""

    text: str
    episodes: list[DataFrame]


@dataclass(frozen=True)
class Flights(Track):
    """A track that navigators of tables fly."""

    @classmethod
    def of(cls, track: str | None = None, **options: Any) -> Flights:
        """Return a track of the benchmark with other options, or one that these options declare; fields of its sheet
        are options, too."""
        base = TRACKS[track] if track else Track()
        return cls(**asdict(base) | {"sheet": base.sheet.taking(options)} | options)

    def fly(self, navigator: Spec, errors: Errors, device: str = "cpu") -> TensorDictBase:
        """Return an episode of each trip."""
        own = options_of(navigator)
        return flown(self.flight(errors, sheet=self.sheet.taking(own), device=device), own)

    def episodes(self, navigator: Spec, errors: Errors, device: str = "cpu") -> list[Measures]:
        """Return the measures of an episode of each trip, once for each run that the pattern of a navigator names."""
        return [episode_measures(self.fly(run, errors, device)) for run in runs_of(navigator)]

    def summaries(self, navigator: Spec, errors: Errors) -> list[dict[str, float]]:
        """Return the summary of each run of a navigator."""
        return [summarize(episodes) for episodes in self.episodes(navigator, errors)]


def options_of(navigator: Spec) -> dict[str, Any]:
    """Return the name of a navigator and its options; elements of its own model are not measured."""
    options = dict(navigator) if isinstance(navigator, Mapping) else {"name": navigator}
    return {key: None if value == OWN_MODEL else value for key, value in options.items()}


def flown(flight: Flight, navigator: Spec) -> TensorDictBase:
    """Return an episode of each vehicle."""
    options = options_of(navigator)
    return flight.fly(flight.navigator(options.pop("name"), **options)).cpu()


def clustered(values: Tensor, region: Tensor) -> tuple[float, float]:
    """Return the mean of ``(N,)`` values, and the half-width of its 95 % interval, clustered by their regions ``(N,)``.

    Values of a region are not independent: the standard error is that of the sums over each region.
    """
    sums = torch.bincount(region, values - values.mean())
    return values.mean().item(), 1.96 * (sums.square().sum() * len(sums) / (len(sums) - 1)).sqrt().item() / len(values)


def paired_difference(first: Tensor, second: Tensor, region: Tensor) -> str:
    """Return the mean difference of two shares ``(N,)`` of the same trips, in percent, with an interval of 95 %.

    An interval that excludes 0 is bold.
    """
    mean, half = clustered(100 * (first - second).double().flatten(), region)
    text = f"{mean:+.1f} ({mean - half:+.1f} to {mean + half:+.1f})"
    return f"**{text}**" if abs(mean) > half else text


def reliability(flight: TensorDictBase, region: Tensor, radius_km: float) -> list[tuple[float, float, float]]:
    """Return mean, share of correct readings and its error for ten bins of the stated probability of arrival.

    In percent; the error is the half-width of an interval of 95 %. Bins of fewer than 100 readings are left out.

    Args:
        flight: ``(N, T)`` from vehicles that declare.
        region: region of each vehicle ``(N,)``.
        radius_km: radius in which a declaration is correct [km].
    """
    flown = first_episode_mask(flight["next", "done"]).squeeze(-1)
    stated, ends = flight["arrival_probability"][flown].squeeze(-1).double(), flight["target_position"][flown]
    right = geodesic(*flight["position"][flown].unbind(-1), *ends.unbind(-1))[0] <= radius_km
    region, bins = region.unsqueeze(-1).expand_as(flown)[flown], (10 * stated).long().clamp_max(9)
    chosen = [bins == place for place in range(10) if (bins == place).sum() >= 100]
    return [(100 * stated[one].mean().item(), *clustered(100 * right[one].double(), region[one])) for one in chosen]


def believed_places(steps: TensorDictBase) -> dict[str, Tensor]:
    """Return where vehicles are by compass and log, and by their track with a model, ``(N, T, 2)`` [deg] each.

    Args:
        steps: ``(N, T)`` after each step, with a track between known places.
    """
    true, target = (steps[key].double() for key in ("position", "target_place"))
    reckoned = [steps["start_place"][:, 0].double()]
    for number in range(steps.shape[1]):  # the heading is that of the leg before
        leg = steps["leg"][:, number, 0].double()
        reckoned.append(move_place(reckoned[-1], steps["heading"][:, number, 0].double(), leg))
    distance, bearing = geodesic(*true.unbind(-1), *target.unbind(-1))
    left = distance.unsqueeze(-1) * torch.stack((torch.cos(bearing), torch.sin(bearing)), -1)
    length, heading = polar(left - steps["track", "displacement", "mean"].double())
    return {"compass and log": torch.stack(reckoned[1:], 1), "and IGRF-13": move_place(true, heading, length)}


def place_errors(steps: TensorDictBase) -> dict[str, Tensor]:
    """Return the errors ``(N, T)`` [km] of :func:`believed_places`, NaN after the end of a flight."""
    over = first_episode_mask(steps["done"]).squeeze(-1).logical_not()
    true = steps["position"].double().unbind(-1)
    return {
        name: geodesic(*place.unbind(-1), *true)[0].masked_fill(over, torch.nan)
        for name, place in believed_places(steps).items()
    }


def digest(data: Path) -> str:
    """Return the digest of the data of a picture."""
    return hashlib.sha256(data.read_bytes()).hexdigest()[:16]


def image_of(figure: Figure) -> Image.Image:
    """Return a figure as an image."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def write_picture(path: Path, figure: Figure, source: str, data: Path | None = None) -> None:
    """Write a picture in at most 256 colors, with metadata that name its source and the data that it is drawn from.

    Args:
        path: file, which is replaced.
        figure: picture.
        source: command that draws it, and what it shows.
        data: file that it is drawn from: its name and digest are the description of the picture.
    """
    check_writable(path)
    metadata = PngInfo()
    metadata.add_text("Source", source)
    if data:
        metadata.add_text("Description", f"{data.name} {digest(data)}")
    image = image_of(figure).quantize(COLORS, Image.Quantize.MAXCOVERAGE, kmeans=1)  # others lose rare colors
    write_with(path, image.save, "PNG", pnginfo=metadata, optimize=True)


def matching(pattern: str) -> list[str]:
    """Return the paths that a pattern names, in natural order.

    Raises:
        FileNotFoundError: for a pattern without a match.
    """
    paths = sorted(glob.glob(pattern), key=lambda path: (len(path), path))
    if not paths:
        raise FileNotFoundError(f"there is no {pattern}: train it by make tables")
    return paths


def runs_of(navigator: Spec) -> list[Spec]:
    """Return a navigator once for each run that its pattern names."""
    label, equals, pattern = navigator.rpartition("=") if isinstance(navigator, str) else ("", "", "")
    return [f"{label}{equals}{run}" for run in matching(pattern)] if "*" in pattern else [navigator]


def cell(runs: Sequence[Measures], measures: Sequence[str], region: Tensor | None = None) -> str:
    """Return measures of the episodes of one or several runs; of several, the SPL has an interval.

    With the region of each episode, measures of one run that are shares of them have an interval, clustered by region.
    """
    summaries = [summarize(episodes) for episodes in runs]
    if len(summaries) == 1:
        return " / ".join(shown(summaries[0][name], runs[0].get(SHARES.get(name, "")), region) for name in measures)
    return " / ".join(
        mean_of_runs([run[name] for run in summaries], form=".1f", interval=name == "spl") for name in measures
    )


def shown(value: float, share: Tensor | None, region: Tensor | None) -> str:
    """Return a value as text; of a share ``(N,)`` of episodes in regions, with the half-width of its interval."""
    if share is None or region is None:
        return "—" if math.isnan(value) else f"{value:.1f}"
    return f"{value:.1f} ± {clustered(100 * share.double().flatten(), region)[1]:.1f}"


def names(navigator: Spec, sheet: Sheet = Sheet()) -> list[str]:
    """Return the label of a navigator, with its options, what it was trained on, and what it knows: :data:`ABOUT`.

    A navigator without a model of the Earth has what it needs instead. Elements of its own model tell it nothing of its
    destination.

    Args:
        navigator: navigator with its options.
        sheet: what vehicles know, beside its options.
    """
    options = options_of(navigator)
    kind = named(runs_of(options.pop("name"))[0]).kind
    text, trained, needs = about(kind)
    columns = {key: options.pop(key) for key in ("start_km", "model", "target_std") if key in options}
    sheet = sheet.replace(**columns)
    known = ["no" if sheet.start_km is None else f"± {sheet.start_km:g} km", sheet.model or needs]
    std = sheet.target_std
    known.append("no" if std is None else "± {:g}°, {:g}°, {:g} nT".format(*std) if any(std) else "exact")
    label = ", ".join([text, *(label_of(*option) for option in options.items())])
    return [label, trained, *(["—", needs, "—"] if kind.name in PLACED else known)]


def label_of(option: str, value: Any) -> str:
    """Return an option of a navigator as text."""
    if option == "confidence":
        return f"declares at {value:g}" if value else "declares at once"
    return f"{option.replace('_', ' ')} {value}"


def titles_of(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the first cell of each row, with what the navigator knows where others have the same."""
    labels = [row[0] for row in rows]
    known = ["; ".join(f"{head}: {cell}" for head, cell in zip(heads[2:], row[2:], strict=False)) for row in rows]
    return [f"{one} ({it})" if labels.count(one) > 1 else one for one, it in zip(labels, known, strict=True)]
