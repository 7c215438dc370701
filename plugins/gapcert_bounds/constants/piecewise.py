"""Constants per convex cell, and jumps where slopes grow as the distance shrinks: for contact, impacts and sticking."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np

from gapcert import Array, UsageError
from gapcert.plugin import Bools, Cells, Ints, LipschitzBound, LipschitzEstimator, LipschitzProblem, Trails, follow
from gapcert_bounds.thresholds import THRESHOLDS

from .cell_tree import Leaf, Tree, edges


@final
class Piecewise(LipschitzEstimator):
    """Constants L_cij = safety × the largest slope of close pairs in and around cell c, jumps J_ci = safety × the largest seen.

    Close pairs along each axis are drawn at random; those that are much steeper than most are cut in four, again and again,
    towards their steepest part. Where the slope settles, it counts as a slope; where it grows with each cut, something jumps
    there. Cells with a jump are halved across it until they are thin, their edges searched for jumps in the same way, so that a
    jump is pursued from cell to cell. Where slopes differ, cells are halved as well. An estimate, never a bound.
    """

    provenance = "estimated"

    def __init__(
        self, safety: float = 1.2, budget: int = 30_000, cells: int = 256, distance: float = 1e-2, thinnest: float = 1e-3
    ) -> None:
        self.safety, self.budget, self.cells, self.distance, self.thinnest = safety, budget, cells, distance, thinnest

    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        """UsageError where there are too many axes for the corners of a box."""
        if len(problem.domain.low) > THRESHOLDS.piecewise_axes:
            raise UsageError(
                f"lipschitz piecewise: {len(problem.domain.low)} states and inputs; it looks at all corners of its cells, of "
                f"which {THRESHOLDS.piecewise_axes} axes make {2**THRESHOLDS.piecewise_axes}; use wood-zhang"
            )
        return _Search(problem, self).bound()


@final
class _Search:
    def __init__(self, problem: LipschitzProblem, options: Piecewise) -> None:
        self.problem, self.options, self.domain = problem, options, problem.domain
        self.noise = 4 * (problem.resolution + problem.predictor.resolution(problem.domain))
        # That of close pairs, which have their hidden state in common where it is drawn.
        self.pair_noise = self.noise
        self.axes = [j for j in range(len(problem.domain.low)) if j not in problem.held]
        self.answers, self.nx = Answers(problem), problem.domain.nx
        self.pairs = Pairs(len(self.domain.low), self.nx)
        self.tree = Tree(self.domain.low, self.domain.high)
        # Segments with a jump in them (k, 2, nz), and its size per state (k, nx).
        self.at, self.sizes = np.empty((0, 2, len(self.domain.low))), np.empty((0, self.nx))
        self._seen: set[bytes] = set()
        self.spent = 0

    def bound(self) -> LipschitzBound:
        self._draw()
        self._follow_steep_pairs()
        self.scale = np.maximum(np.ptp(self.answers.g, axis=0), 64 * self.noise + np.finfo(float).tiny)
        self._split_by_slope(self.options.cells // 8)
        self._split_by_jump()
        self._split_by_slope(self.options.cells)
        return self._conclude()

    def _draw(self) -> None:
        """Close pairs along each axis, uniform on Z."""
        o, count = self.options, max(2, int(THRESHOLDS.pair_share * self.options.budget / (2 * len(self.axes))))
        segments, axes = [], []
        for j in self.axes:
            rng = np.random.default_rng([self.problem.seed, j, 0xCE11])
            start = self.domain.draw(count, rng)
            step = o.distance * self.domain.width[j] * (0.5 + 0.5 * rng.random(count))
            low, high = self.domain.chord(start, j)
            end = start.copy()
            end[:, j] = np.where(start[:, j] + step <= high, start[:, j] + step, start[:, j] - step)
            pair = np.sort(np.stack([start, end], axis=1), axis=1)[(end[:, j] >= low) & (end[:, j] <= high)]
            segments.append(pair[self.domain.contains(pair[:, 0]) & self.domain.contains(pair[:, 1])])
            axes.append(np.full(len(segments[-1]), j))
        ends = np.concatenate(segments)
        if self.problem.paired is None:
            g = self.answers(ends.reshape(-1, ends.shape[2])).reshape(len(ends), 2, -1)
            change = g[:, 1] - g[:, 0]
        else:
            change, resolution = self.problem.change("lipschitz-pairs", ends[:, 0], ends[:, 1])
            self.pair_noise, self.spent = 4 * resolution, 2 * len(ends)
        self.pairs.add(ends, np.concatenate(axes), np.abs(change))

    def _follow_steep_pairs(self) -> None:
        """Batch after batch of the steepest pairs of each state and axis, until none of a batch grows: the rest are slopes."""
        slopes = self.pairs.slopes(self.pair_noise)
        jumped = np.zeros(len(slopes), dtype=bool)
        clear = self.pairs.change > THRESHOLDS.change_clear * self.noise
        queues = {}
        for j in self.axes:
            own = self.pairs.axis == j
            usual = np.quantile(slopes[own], 0.75, axis=0) if own.any() else np.zeros(self.nx)
            for i in range(self.nx):
                rows = np.flatnonzero(own & clear[:, i] & (slopes[:, i] > 3 * usual[i]))
                queues[i, j] = rows[np.argsort(-slopes[rows, i], kind="stable")]
        while queues and len(self.answers) < THRESHOLDS.trail_share * self.options.budget:
            batch = [(i, j, row) for (i, j), rows in queues.items() for row in rows[:16]]
            if not batch:
                break
            state, axis, rows = (np.array(part, dtype=np.intp) for part in zip(*batch, strict=True))
            grew = self._pursue(self.pairs.ends[rows], state)
            jumped[rows[grew]] = True
            alive = set(zip(state[grew].tolist(), axis[grew].tolist(), strict=True))
            queues = {key: left[16:] for key, left in queues.items() if key in alive and len(left) > 16}
        for (i, _), rows in queues.items():
            # The budget ended first: what was not followed counts as a jump where it was seen.
            self._record(self.pairs.ends[rows], np.eye(self.nx)[i] * self.pairs.change[rows])
            jumped[rows] = True
        self.pairs.drop(np.concatenate([jumped, np.zeros(len(self.pairs.axis) - len(jumped), dtype=bool)]))

    def _pursue(self, segments: Array, state: Ints, enough: Array | None = None) -> Bools:
        """Follow segments for one state each: jumps are recorded, settled slopes become pairs; (n,) where one jumped."""
        long = (np.abs(segments[:, 1] - segments[:, 0]) / self.domain.width).max(axis=1)
        steps = np.ceil(np.log(np.maximum(long * THRESHOLDS.trail_end / self.options.thinnest, 1.0)) / np.log(4.0)).astype(
            np.intp
        )
        trails = self.answers.follow(segments, state, self.noise, np.maximum(steps, 3), enough)
        grew = trails.growing
        self._record(trails.z[grew], np.eye(self.nx)[state[grew]] * trails.change[grew])
        moved = trails.z[:, 0] != trails.z[:, 1]
        # What ended at an allowed slope tells nothing new, and would be multiplied by the safety factor again.
        straight = ~grew & ~trails.settled & (trails.steps > 0) & (moved.sum(axis=1) == 1)
        self.pairs.add(np.sort(trails.z[straight], axis=1), moved[straight].argmax(axis=1), trails.change[straight])
        return grew

    def _record(self, segments: Array, sizes: Array) -> None:
        self.at, self.sizes = np.concatenate([self.at, segments]), np.concatenate([self.sizes, sizes])

    def _constants(self, region: tuple[Array, Array]) -> Array:
        """(nx, nz): what the pairs in and around a box say, and what noise may hide: of a slope that was seen, noise over the
        box; else noise over a pair, which is all that pairs tell.

        Around it, because a steep part that reaches into a corner of the box alone is met by few pairs inside.
        """
        width = region[1] - region[0]
        slopes = self.pairs.steepest(
            self.pairs.within(region[0] - THRESHOLDS.cell_pad * width, region[1] + THRESHOLDS.cell_pad * width), self.pair_noise
        )
        hidden = np.where(slopes > 0, width, np.minimum(width, self.options.distance * self.domain.width))
        constants = self.options.safety * slopes + self.pair_noise[:, None] / hidden
        constants[:, list(self.problem.held)] = 0.0
        return np.asarray(constants)

    def _split_by_slope(self, most: int) -> None:
        """Halve cells, up to `most` in all, where that makes constants smaller by a fifth and the halves hold pairs enough."""
        waiting = list(self.tree.leaves)
        while waiting and len(self.tree.leaves) < most:
            leaf = waiting.pop(0)
            best, halves = 0.8 * self._looseness(leaf), None
            for j in range(len(leaf.low)):
                pair = leaf.halves(j, float((leaf.low[j] + leaf.high[j]) / 2))
                if all(self._own_region(half) for half in pair) and all(half.point(self.domain) is not None for half in pair):
                    loose = (self._looseness(pair[0]) + self._looseness(pair[1])) / 2
                    if loose < best:
                        best, halves = loose, (j, pair)
            if halves is not None:
                axis, pair = halves
                self.tree.replace(leaf, axis, float(pair[0].high[axis]), pair)
                waiting += pair

    def _looseness(self, leaf: Leaf) -> float:
        return float((self._constants(leaf.region) @ leaf.width / self.scale).sum())

    def _own_region(self, leaf: Leaf) -> bool:
        """Take the leaf's own box as its region if it holds pairs enough."""
        if self.pairs.count(self.pairs.within(leaf.low, leaf.high), self.axes) >= THRESHOLDS.cell_pairs:
            leaf.region = (leaf.low, leaf.high)
        return leaf.region[0] is leaf.low

    def _split_by_jump(self) -> None:
        """Halve the cells whose jumps cost most, across the jump; a jump is pursued from cell to cell along their edges."""
        self._search_edges(self.tree.leaves)
        while True:
            self._pursue_jumps()
            room = min(self.options.cells - self.options.cells // 8 - len(self.tree.leaves), 32)
            costs = [self._cost(leaf) for leaf in self.tree.leaves]
            if room <= 0 or not any(costs) or len(self.answers) >= self.options.budget:
                return
            order = np.argsort(-np.array(costs), kind="stable")
            new: list[Leaf] = []
            for leaf in [self.tree.leaves[k] for k in order if costs[k] > max(costs) / 4][:room]:
                new += self._halve(leaf)
            self._search_edges(new)

    def _halve(self, leaf: Leaf) -> tuple[Leaf, ...]:
        axis = self._across(leaf)
        pair = leaf.halves(axis, float((leaf.low[axis] + leaf.high[axis]) / 2))
        if any(half.point(self.domain) is None for half in pair):
            leaf.whole = True
            return ()
        for half in pair:
            self._own_region(half)
        self.tree.replace(leaf, axis, float(pair[0].high[axis]), pair)
        return pair

    def _pursue_jumps(self) -> None:
        """Search the edges of all cells with a jump, and then those of the cells that it is found to reach into."""
        while len(self.answers) < THRESHOLDS.jump_budget * self.options.budget:
            pending = [leaf for leaf in self.tree.leaves if not leaf.searched and self._hits(leaf).any()]
            if not pending:
                return
            for leaf in pending:
                leaf.searched = True
            self._search_edges(pending, closely=True)

    def _hits(self, leaf: Leaf) -> Bools:
        return leaf.holds(self.at.min(axis=1), self.at.max(axis=1))

    def _jump(self, leaf: Leaf) -> Array:
        """(nx,) the largest jump that was seen in the closed cell."""
        return np.asarray(self.sizes[self._hits(leaf)].max(axis=0, initial=0.0))

    def _cost(self, leaf: Leaf) -> float:
        if self._across(leaf) < 0:
            return 0.0
        return float(np.prod(leaf.width / self.domain.width) * (self._jump(leaf) / self.scale).sum())

    def _across(self, leaf: Leaf) -> int:
        """The axis along which the cell jumps most and which is not yet thin; −1: there is none.

        Edges that are steeper than constants allow tell; where there are none, the directions in which jumps were found.
        """
        relative = leaf.width / self.domain.width
        thick = (relative > 2 * self.options.thinnest) & (not leaf.whole)
        weight: Array = leaf.crossing
        if not (weight > 0).any():
            hits = self._hits(leaf)
            along = (self.at[hits, 0] != self.at[hits, 1]).argmax(axis=1)
            weight = np.bincount(along, (self.sizes[hits] / self.scale).sum(axis=1), minlength=len(relative)).astype(np.float64)
        # Of equal ones the longest.
        weight = np.where(thick, weight, 0.0) * (1 + 1e-6 * relative)
        return int(weight.argmax()) if weight.any() else -1

    def _search_edges(self, leaves: Sequence[Leaf], closely: bool = False) -> None:
        """Ask for the corners; follow edges that are steeper than the constants around them allow, or `closely` all of them.

        A plane that cuts a box cuts off a corner, and one that leaves it by a face crosses edges of that face: so a jump that
        is nearly flat across a cell is seen on its edges, in this cell and where it enters the next.
        """
        first, second, axis = edges(len(self.domain.low))
        corners = [self._corners(leaf) for leaf in leaves]
        if leaves:
            self.answers(np.concatenate([z for z, _ in corners]))
        segments, states, enough = [], [], []
        for leaf, (z, known) in zip(leaves, corners, strict=True):
            g = self.answers(z)
            change, clear = np.abs(g[second] - g[first]), THRESHOLDS.change_clear * self.noise
            allowed = np.abs(z[second] - z[first]) @ self._constants(leaf.region).T
            change[~(known[first] & known[second])] = 0.0
            excess = np.maximum(change - allowed - clear, 0.0)
            leaf.crossing = np.bincount(axis, (excess / self.scale).sum(axis=1), minlength=len(leaf.low)).astype(np.float64)
            for k, i in np.argwhere(change > clear if closely else excess > 0):
                key = np.concatenate([z[first[k]], z[second[k]], [i, closely and excess[k, i] == 0]]).tobytes()
                if key not in self._seen:
                    self._seen.add(key)
                    segments.append(z[[first[k], second[k]]])
                    states.append(i)
                    enough.append(allowed[k, i] / self.options.safety)
        if segments:
            self._pursue(np.array(segments), np.array(states, dtype=np.intp), np.array(enough))

    def _corners(self, leaf: Leaf) -> tuple[Array, Bools]:
        """(corners moved into Z, which of them are in Z and in the leaf); the others stand at the leaf's point."""
        moved, known = leaf.within(self.domain, leaf.corners())
        stand_in = leaf.point(self.domain)
        return np.where(known[:, None], moved, stand_in if stand_in is not None else self.domain.centre), known

    def _conclude(self) -> LipschitzBound:
        leaves = self.tree.leaves
        made = [self._cell(leaf) for leaf in leaves]
        constants, sizes = np.array([c for c, _ in made]), np.array([j for _, j in made])
        anchors = [point for leaf in leaves if (point := leaf.point(self.domain)) is not None]
        for leaf, size in zip(leaves, sizes, strict=True):
            if size.any():
                moved, known = leaf.within(self.domain, leaf.corners())
                anchors += list(moved[known])
        anchors = list(np.unique(np.array(anchors), axis=0))
        cells = Cells(self.tree.low, self.tree.high, *self.tree.cuts(), constants, sizes, np.array(anchors))
        lower = (
            np.maximum(self.pairs.change - np.maximum(self.noise, self.pair_noise), 0.0)
            / self.pairs.length[:, None]
            * (1 - 1e-12)
        )
        nz = len(self.domain.low)
        seen = np.stack([lower[self.pairs.axis == j].max(axis=0, initial=0.0) for j in range(nz)], axis=1)
        jumps = []
        for i in np.flatnonzero(self.sizes.max(axis=0, initial=0.0)):
            k = int(self.sizes[:, i].argmax())
            jumps.append({"state": int(i), "where": self.at[k].mean(axis=0).tolist(), "size": float(self.sizes[k, i])})
        method = f"piecewise ({len(cells)} cells, of which {int(cells.marked.sum())} jump)"
        o = self.options
        return LipschitzBound(
            cells.worst,
            seen,
            "estimated",
            method,
            o.safety,
            len(self.answers) + self.spent,
            cells=cells,
            diagnostics={"jumps": jumps},
        )

    def _cell(self, leaf: Leaf) -> tuple[Array, Array]:
        """Constants (nx, nz) and jumps (nx,) of a leaf, widened until they allow whatever is known of it."""
        constants, jumps = self._constants(leaf.region), self.options.safety * self._jump(leaf)
        rows = np.flatnonzero(leaf.holds(self.answers.z, self.answers.z))
        rows = rows[np.linspace(0, len(rows) - 1, min(THRESHOLDS.compared_points, len(rows))).astype(int)]
        z, g = self.answers.z[rows], self.answers.g[rows]
        a, b = np.triu_indices(len(rows), 1)
        apart, change = np.abs(z[a] - z[b]), np.maximum(np.abs(g[a] - g[b]) - self.noise, 0.0)
        for i in range(self.nx if len(a) else 0):
            allowed = apart @ constants[i]
            excess = float((change[:, i] - allowed).max())
            if excess <= jumps[i]:
                continue
            ratio = float((change[:, i] / np.maximum(allowed, np.finfo(float).tiny)).max())
            # A cell with a jump, or one that was missed, takes what is left over as jump; elsewhere slopes were underestimated.
            if jumps[i] > 0 or ratio > 4:
                jumps[i] = self.options.safety * excess
            else:
                constants[i] *= self.options.safety * ratio
        return constants, jumps


@final
class Answers:
    """g at every point that was asked about: z (n, nz), g (n, nx). Each is asked once, each round under a name of its own."""

    def __init__(self, problem: LipschitzProblem) -> None:
        self.problem = problem
        self.z, self.g = np.empty((0, len(problem.domain.low))), np.empty((0, problem.domain.nx))
        self._row: dict[bytes, int] = {}
        self._rounds = 0

    def __len__(self) -> int:
        return len(self.z)

    def __call__(self, z: Array) -> Array:
        """g at points z (n, nz)."""
        keys = [row.tobytes() for row in np.ascontiguousarray(z) + 0.0]
        fresh: dict[bytes, int] = {}
        for k, key in enumerate(keys):
            if key not in self._row:
                fresh.setdefault(key, k)
        if fresh:
            new = z[list(fresh.values())]
            g = self.problem.remainder(f"lipschitz-{self._rounds:03d}", new)
            self._rounds += 1
            self._row |= {key: len(self.z) + k for k, key in enumerate(fresh)}
            self.z, self.g = np.concatenate([self.z, new]), np.concatenate([self.g, g])
        return np.asarray(self.g[[self._row[key] for key in keys]])

    def follow(self, z: Array, state: Ints, noise: Array, steps: Ints, enough: Array | None) -> Trails:
        """Segments z (n, 2, nz) of known ends, each followed for its state."""
        ends = self(z.reshape(-1, z.shape[2])).reshape(len(z), 2, -1)
        return follow(lambda _, points: self(points), z, ends, state, noise, steps, enough)


@final
class Pairs:
    """Segments along single axes across which nothing jumps: ends (n, 2, nz), axis (n,), change (n, nx) = |Δg|."""

    def __init__(self, nz: int, nx: int) -> None:
        self._keep(np.empty((0, 2, nz)), np.empty(0, dtype=np.intp), np.empty((0, nx)))

    def _keep(self, ends: Array, axis: Ints, change: Array) -> None:
        self.ends, self.axis, self.change = ends, axis, change
        rows = np.arange(len(axis))
        self.length = ends[rows, 1, axis] - ends[rows, 0, axis]
        self.middle = (ends[:, 0] + ends[:, 1]) / 2

    def add(self, ends: Array, axis: Ints, change: Array) -> None:
        axes = np.concatenate([self.axis, axis])
        self._keep(np.concatenate([self.ends, ends]), axes, np.concatenate([self.change, change]))

    def drop(self, rows: Bools) -> None:
        self._keep(self.ends[~rows], self.axis[~rows], self.change[~rows])

    def within(self, low: Array, high: Array) -> Bools:
        """(n,): the middle lies in the box."""
        inside = np.ones(len(self.axis), dtype=bool)
        for j in range(len(low)):
            inside &= (self.middle[:, j] >= low[j]) & (self.middle[:, j] <= high[j])
        return inside

    def slopes(self, noise: Array, rows: Bools | slice = slice(None)) -> Array:
        """(n, nx), 0 where the change is no more than the arithmetic's noise."""
        return np.asarray(np.where(self.change[rows] > noise, self.change[rows], 0.0) / self.length[rows, None])

    def steepest(self, rows: Bools, noise: Array) -> Array:
        """(nx, nz): the largest slope of each state along each axis among some of the pairs."""
        slopes, axis = self.slopes(noise, rows), self.axis[rows]
        parts = [slopes[axis == j].max(axis=0, initial=0.0) for j in range(self.ends.shape[2])]
        return np.stack(parts, axis=1)

    def count(self, rows: Bools, axes: Sequence[int]) -> int:
        """How many of them that one of the axes has which has the fewest."""
        return int(np.bincount(self.axis[rows], minlength=self.ends.shape[2])[list(axes)].min())
