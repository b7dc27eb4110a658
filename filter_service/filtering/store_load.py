"""Loading of a built store by the thread of the builder, beside frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from filter_service.building.jobs import BuiltStore
from filter_service.filtering.priority_lock import PriorityLock
from filter_service.filtering.psf_work import PsfWork, first_psfs
from filter_service.filtering.stream_eyes import (
    BuildTarget,
    PreparedStore,
    StreamEyes,
)
from filter_service.rendering.engine import FrameEngine


@dataclass(eq=False)
class StoreLoad:
    """A built store that is being loaded.

    `compute` needs no lock, because frames do not know the store yet.

    Attributes
    ----------
    engine : FrameEngine
    stream : StreamEyes
    target : BuildTarget
    ticket : int
    built : BuiltStore
    enough : int
        Number of PSFs of a first frame that may be missing.
    late_parts : list
        Parts of the store that arrive meanwhile.
    prepared : PreparedStore, optional
        The loaded store, with the missing PSFs of a first frame as its work.
    error : Exception, optional
        Why it could not be loaded.
    """

    engine: FrameEngine
    stream: StreamEyes
    target: BuildTarget
    ticket: int
    built: BuiltStore
    enough: int
    late_parts: list[Any] = field(default_factory=list)
    prepared: PreparedStore | None = None
    error: Exception | None = None

    @property
    def is_done(self) -> bool:
        """Return whether the store is loaded, or could not be."""
        return self.prepared is not None or self.error is not None

    def compute(self, lock: PriorityLock, is_over: Callable[[], bool]) -> None:
        """Load the store and compute PSFs, see `PsfWork.compute`."""
        eye, camera = self.target
        try:
            store = self.engine.load(self.built.store)
            for part in self.built.parts:
                store.add_part(part)
            psfs = first_psfs(
                *(store, camera, eye.settings, self.stream.history),
                is_first_check=True,
            )
            work = PsfWork(store, psfs, enough=self.enough) if psfs.size else None
        except Exception as error:  # reported by the builder
            self.error = error
            return
        prepared = PreparedStore(
            *(camera, store, eye.accepted_s, self.built.notes),
            work=work,
            n_checks=1,
            ticket=self.ticket,
        )
        if work is not None:
            work.compute(lock, is_over)
        self.prepared = prepared
