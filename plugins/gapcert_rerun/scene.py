"""Pictures in a plane, seen from above: two axes of any units on a unit square, y up, with their names and limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from gapcert import Axis

Array = npt.NDArray[np.float64]
WITH, WITHOUT, TRUTH, FAINT = (110, 168, 255, 255), (255, 154, 77, 255), (240, 240, 240, 255), (150, 156, 166, 255)
ONLY_WITH, GOOD, BAD = (60, 190, 178, 255), (95, 209, 151, 255), (255, 105, 120, 255)
STEP = 1.25  # from one square to the next


@final
@dataclass(frozen=True)
class Plane:
    """The first two axes on the unit square whose lower left corner is (shift, 0)."""

    x: Axis
    y: Axis
    shift: float = 0.0

    def at(self, points: Array, height: float = 0.01) -> Array:
        """Points (…, ≥ 2) in axis units → (…, 3) in the scene."""
        u = (points[..., 0] - self.x.low) / (self.x.high - self.x.low) + self.shift
        v = (points[..., 1] - self.y.low) / (self.y.high - self.y.low)
        return np.stack([u, v, np.full_like(u, height)], axis=-1)

    def frame(self, title: str) -> list[Any]:
        """The outline, and what its sides mean."""
        s, x, y = self.shift, self.x, self.y
        corners = np.asarray([[s, 0, 0], [s + 1, 0, 0], [s + 1, 1, 0], [s, 1, 0], [s, 0, 0]])
        sides = f"→ {x.name} {x.low:.4g} … {x.high:.4g} {x.unit}\n↑ {y.name} {y.low:.4g} … {y.high:.4g} {y.unit}"
        places, texts = [[s + 0.5, 1.07, 0], [s + 0.5, -0.09, 0]], [title, sides]
        marks = rr.Points3D(places, labels=texts, radii=0.0, colors=[TRUTH] * 2, show_labels=True)
        return [rr.LineStrips3D([corners], colors=[FAINT], radii=0.003), marks]

    def heat(self, values: Array, top: float) -> rr.GridMap:
        """Values (n, n), row = y, from 0 to `top`, as colours; nothing where there is no value (NaN)."""
        level, absent = np.clip(np.nan_to_num(values / top if top > 0 else values), 0, 1), np.isnan(values)
        if absent.any():
            from matplotlib import colormaps

            pixels = colormaps["viridis"](level[::-1], bytes=True)
            pixels[absent[::-1]] = 0
            return self._map(pixels, "RGBA", None)
        return self._map((255 * level[::-1]).astype(np.uint8), "L", rr.components.Colormap.Viridis)

    def mask(self, values: npt.NDArray[np.bool_], colour: tuple[int, int, int, int]) -> rr.GridMap:
        """The cells (n, n) that are set, in one colour."""
        return self._map(np.where(values[::-1, :, None], np.asarray(colour), 0).astype(np.uint8), "RGBA", None)

    def _map(self, pixels: npt.NDArray[np.uint8], model: Literal["L", "RGBA"], colormap: Any) -> rr.GridMap:
        n = pixels.shape[0]
        kind = rr.components.ImageFormat(width=n, height=n, color_model=model, channel_datatype="U8")
        place = [self.shift, 0.0, 0.0]
        return rr.GridMap(data=pixels.tobytes(), format=kind, cell_size=1.0 / n, translation=place, colormap=colormap)

    def polygon(self, points: Array, colour: tuple[int, int, int, int], name: str = "") -> rr.LineStrips3D:
        """The outline with these corners (k, 2), and its name in the middle."""
        strip = self.at(np.vstack([points, points[:1]]), 0.02)
        labels = [name] if name else None
        return rr.LineStrips3D([strip], colors=[colour], radii=0.004, labels=labels, show_labels=bool(name))


def view(origin: str, name: str, squares: int = 1) -> rrb.Spatial3DView:
    """A camera above `squares` unit squares side by side."""
    middle = (STEP * (squares - 1) + 1) / 2
    height = 1.6 if squares == 1 else 0.8 * squares
    eye = rrb.EyeControls3D(position=[middle, 0.5, height], look_target=[middle, 0.5, 0.0], eye_up=[0.0, 1.0, 0.0])
    return rrb.Spatial3DView(origin=origin, name=name, eye_controls=eye, line_grid=False, spatial_information=None)


def series(root: str, name: str, low: float, high: float) -> rrb.TimeSeriesView:
    """A plot with its y range given, since the viewer's own needs some frames to settle."""
    axis, legend = rrb.ScalarAxis(range=(low, high)), rrb.PlotLegend(visible=False)
    return rrb.TimeSeriesView(origin=root, name=name, axis_y=axis, plot_legend=legend)
