"""PSFs that the thread of the builder computes beside frames, and which these are.

A frame that needs a new node of pupil or accommodation takes 1,000 to 5,000 new PSFs.
They are computed before such a frame, if the stream predicts it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import Camera
from filter_service.filtering.frame_history import FrameHistory
from filter_service.filtering.priority_lock import PriorityLock
from filter_service.psfs.pack import ComputedPsfs
from filter_service.psfs.store import StateNode
from filter_service.rendering.frame_kernels import first_frame
from filter_service.rendering.frame_states import FrameStore
from filter_service.settings import FilterSettings
from filter_service.view_state import State

BATCH = 256
"""PSFs per batch, 5 ms on two cores."""

SPREAD_BATCH = 64
"""PSFs per batch of work that is spread over frames."""

PAUSE_S = 0.002
"""Interval of checks during the pauses between such batches."""

BUILD_LEAD_S = 0.4
"""Time after the last frame for which the nodes of a new eye are predicted."""

FIRST_LEAD_S, FIRST_LEAD_FRAMES = 0.2, 2.0
"""Time after the last frame for which the PSFs of a first frame are predicted, and the
least number of frame intervals."""

LEADS_S = (0.06, 0.12, 0.25, 0.4)
"""Times after the last frame for which states between other nodes are predicted."""

IDLE_LEADS_S = (0.12, 0.4)
"""The same for states between the same nodes, which need few new PSFs."""

LATEST_RATIO = 0.7
"""Share of such a time after which the PSFs should be computed."""


@dataclass(eq=False)
class PsfWork:
    """Missing PSFs of a store.

    `compute` needs no lock: it does not change the store, which frames may use.

    Attributes
    ----------
    store : FrameStore
    left : (n,)
        PSFs that are not computed yet.
    due_s : float, optional
        Time of `time.monotonic` until which the work is spread evenly; by default, it
        is done as soon as possible.
    enough : int
        Number of PSFs that may be left, for the frame that needs them.
    done : list of ComputedPsfs
        Results that `add` adds to the store.
    error : Exception, optional
        Error of `compute`, which `add` raises.
    history : FrameHistory, optional
        Frames of a stream.  A new one interrupts `compute`, because its predictions may
        be more urgent.
    """

    store: FrameStore
    left: NDArray[np.int64]
    due_s: float | None = None
    enough: int = 0
    history: FrameHistory | None = None
    done: list[ComputedPsfs] = field(default_factory=list)
    error: Exception | None = None

    def __post_init__(self) -> None:
        """Leave out PSFs that are computed, or share a kernel with another."""
        self.left = self.store.not_computed(self.left)

    def compute(self, lock: PriorityLock, is_over: Callable[[], bool]) -> None:
        """Compute at least one batch, and more while frames hold the lock.

        Beside a frame, this uses a single thread, and otherwise one for each core.

        Parameters
        ----------
        lock : PriorityLock
            Lock that `add` needs.
        is_over : callable
            Returns whether to stop.
        """
        while self.left.size and not (self._is_interrupted or is_over()):
            is_beside = lock.has_foreground
            is_spread = is_beside and self.due_s is not None
            count, started_s = SPREAD_BATCH if is_spread else BATCH, time.monotonic()
            try:
                found = self.store.computed(
                    self.left[:count], thread_count=1 if is_beside else None
                )
            except Exception as error:  # reported by `add`, which holds the lock
                self.error = error
                return
            self.done.append(found)
            end_s = self._batch_end_s(started_s) if is_spread else started_s
            self.left = self.left[count:]
            while lock.has_foreground and time.monotonic() < end_s:
                if self._is_interrupted or is_over():
                    return
                time.sleep(PAUSE_S)
            if self.is_enough or not lock.has_foreground:
                return

    @property
    def is_enough(self) -> bool:
        """Return whether a frame may compute the PSFs that are left."""
        return self.left.size <= self.enough

    @property
    def _is_interrupted(self) -> bool:
        history = self.history
        return self.store.is_released or (
            history is not None and history.last is not history.last_predicted
        )

    def put_before(self, psfs: NDArray[np.int64], due_s: float) -> None:
        """Compute more PSFs (n,) first."""
        psfs = self.store.not_computed(psfs)
        rest = self.left[np.isin(self.left, psfs, invert=True)]
        self.left, self.due_s = np.concatenate([psfs, rest]), due_s

    def _batch_end_s(self, started_s: float) -> float:
        """Return the time at which the next batch starts, if all take equally long."""
        assert self.due_s is not None
        return started_s + (self.due_s - started_s) * SPREAD_BATCH / self.left.size

    def add(self) -> None:
        """Add the results to the store, or raise the error.

        Raises
        ------
        GridTooLarge, BuildFailed, OutOfMemory
            As `PsfStore.fill`.
        """
        if self.error is not None:
            raise self.error
        done, self.done = self.done, []
        for found in done:
            self.store.add(found)


def likely_state(
    camera: Camera, settings: FilterSettings, history: FrameHistory
) -> State:
    """Return the likely pupil and focus of the first frame through a new eye."""
    use = history.last or first_frame(camera, settings)
    return history.predicted(BUILD_LEAD_S) or use.state


def first_psfs(
    store: FrameStore,
    camera: Camera,
    settings: FilterSettings,
    history: FrameHistory,
    *,
    is_first_check: bool,
) -> NDArray[np.int64]:
    """Return missing PSFs (n,) of a first frame, in its likely state.

    Parameters
    ----------
    is_first_check : bool
        Whether many PSFs may be missing, so that their frame is not the next one.
    """
    if settings.prepare == "ranges":
        return store.missing_psfs(None)
    use = history.last or first_frame(camera, settings)
    lead_s = FIRST_LEAD_FRAMES * history.interval_s
    lead_s = max(FIRST_LEAD_S, lead_s) if is_first_check else history.interval_s
    soon = history.predicted(lead_s) or use.state
    if soon != use.state and not store.is_planned(store.state_nodes(soon)):
        soon = use.state
    return store.missing_psfs(use, state=soon)


@dataclass(eq=False)
class PredictedNodes:
    """Nodes of pupil and accommodation that were predicted for a stream.

    Attributes
    ----------
    last : tuple of StateNode
        Nodes of the last frame.
    found : set
        Other nodes whose PSFs were looked for since then, each with its time, and
        nodes that the worker plans.
    """

    last: tuple[StateNode, ...] = ()
    found: set[Hashable] = field(default_factory=set)


def predicted_work(
    store: FrameStore,
    history: FrameHistory,
    known: PredictedNodes,
    plan_near: Callable[[State], None],
    *,
    is_busy: bool,
    work: PsfWork | None = None,
) -> PsfWork | None:
    """Return missing PSFs of predicted states, the nearest state first.

    Parameters
    ----------
    known : PredictedNodes
        Nodes that were predicted before, which this updates.
    plan_near : callable
        Asks the worker to plan the nodes near a state.
    is_busy : bool
        Look only for states that read other nodes than the last frame.
    work : PsfWork, optional
        PSFs that are already being computed, to which this adds others.
    """
    last = history.last
    if last is None or last is history.last_predicted:
        return work
    history.last_predicted = last
    here = store.state_nodes(last.state)
    if known.last != here:
        known.last, known.found = here, set()
    for lead_s in LEADS_S:
        state = history.predicted(lead_s)
        if state is None:
            return work
        nodes = store.state_nodes(state)
        if set(nodes) <= set(here):
            if is_busy or work is not None or lead_s not in IDLE_LEADS_S:
                continue
        elif (lead_s, nodes) in known.found:
            continue
        elif not store.is_planned(nodes):
            if nodes not in known.found:
                known.found.add(nodes)
                plan_near(state)
            continue
        else:
            known.found.add((lead_s, nodes))
        psfs = store.missing_psfs(last, state=state)
        if psfs.size:
            due_s = time.monotonic() + LATEST_RATIO * lead_s
            if work is None:
                return PsfWork(store, psfs, due_s, history=history)
            work.put_before(psfs, due_s)
            return work
    return work
