"""PSFs that are computed when frames need them: a frame depends on its input alone."""

import pickle
import time
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from estimator.profiles.parse import parse_profile
from filter_service.building.jobs import BuildDone, BuildError, BuildJob, BuildPart
from filter_service.building.worker_handle import WorkerHandle
from filter_service.camera import Camera
from filter_service.errors import BuildFailed, OutOfMemory
from filter_service.filtering import psf_work
from filter_service.filtering.frame_history import FrameHistory
from filter_service.filtering.priority_lock import PriorityLock
from filter_service.filtering.psf_work import (
    BATCH,
    PAUSE_S,
    SPREAD_BATCH,
    PredictedNodes,
    PsfWork,
    predicted_work,
)
from filter_service.planning.cost import states_of
from filter_service.planning.node_wavefronts import state_survey
from filter_service.planning.plan import plan_axes, unchecked_plan
from filter_service.psfs.frame_layers import frame_layers, state_nodes
from filter_service.psfs.store import PsfStore, build_psf_store
from filter_service.rendering.frame_kernels import (
    MissingPsfs,
    SampledFrame,
    SampledView,
    first_frame,
    frame_kernels,
    interval_count,
)
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from filter_service.view_state import State
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.numerical.synthetic import depth_scene, psnr_db, tangents, texture

WIDTH, HEIGHT, FOV_DEG = 150, 101, 50.0
STATES = (
    {"pupil_diameter_mm": 3.3, "focus_dpt": 0.2},
    {"pupil_diameter_mm": 4.2, "focus_dpt": 0.9, "render_tolerance": 0.05},
    {"pupil_diameter_mm": 6.1, "focus_dpt": 0.0},
)


@pytest.fixture(scope="module")
def known():
    """Eye, spec and plan of a keratoconus whose pupil and focus may move."""
    spec = spec_for(
        WIDTH,
        HEIGHT,
        FOV_DEG,
        mode="dynamic",
        tolerance="loose",
        pupil_range_mm=(3.0, 6.5),
        focus_range_dpt=(0.0, 2.0),
        object_range_dpt=(0.0, 3.0),
    )
    eye = traced_eye("keratoconus", spec)
    return eye, spec, unchecked_plan(eye, spec, predict=False)


@pytest.fixture(scope="module")
def streamed(known):
    """The same, whose states are planned when they are first read."""
    eye, spec, _ = known
    return eye, spec, plan_axes(eye, spec)


@pytest.fixture(scope="module")
def views():
    rng = np.random.default_rng(3)
    color = (255 * texture(rng, HEIGHT, WIDTH, cell_px=3)).astype(np.uint8)
    many_m = rng.uniform(0.35, 4.0, (HEIGHT, WIDTH)).astype(np.float32)
    lines = tangents(WIDTH, HEIGHT, FOV_DEG)
    return [RgbdView(color, m, lines) for m in (depth_scene(), many_m)]


def frames(views):
    return [(view, state) for view in views for state in STATES]


def pictures(renderer, store, asked):
    handle = renderer.load(store)
    return [
        renderer.render(view, handle, **state, output="srgb8").color.tobytes()
        for view, state in asked
    ]


@pytest.fixture(scope="module")
def alone(known, views):
    """Every frame as the first of an eye."""
    from filter_service.rendering.native import NativeRenderer

    asked = frames(views)
    return [pictures(NativeRenderer(), PsfStore(*known), [one])[0] for one in asked]


def test_a_frame_is_the_same_after_any_others(streamed, views, alone):
    from filter_service.rendering.native import NativeRenderer

    asked = frames(views)
    store = PsfStore(*streamed)
    assert pictures(NativeRenderer(), store, asked) == alone
    assert pictures(NativeRenderer(), store, asked[::-1]) == alone[::-1]
    backward = pictures(NativeRenderer(), PsfStore(*streamed), asked[::-1])
    assert backward == alone[::-1]


def test_nodes_do_not_depend_on_what_was_planned_before(known, streamed):
    plan, store = known[2], PsfStore(*streamed)
    n_pupils, n_used = plan.group_shape[:2]
    states = [(p, a) for p in range(n_pupils) for a in range(n_used)]
    for state in states[::-1]:
        store.groups_of([state])
    assert store.psf_count == len(plan.nodes.blur_px)
    whole, found = plan.nodes, store.nodes
    fields = np.arange(store.fields_count)
    for number, first in enumerate(store.groups_of(states).tolist()):
        for field in fields.tolist():
            own, same = first + field, number * fields.size + field
            one, other = (
                nodes.defocus.values_dpt[slice(*nodes.defocus.starts[k : k + 2])]
                for nodes, k in ((found, own), (whole, same))
            )
            np.testing.assert_array_equal(one, other)
        own, same = first + fields, number * fields.size + fields
        for name in ("zernike_um", "per_dpt_um", "pupil_ellipse", "pixel_from_mrad"):
            one, other = (getattr(n.wavefronts, name) for n in (found, whole))
            np.testing.assert_array_equal(one[own], other[same])


def test_nodes_planned_ahead_serve_frames_as_they_would_plan_them(
    streamed, views, alone, monkeypatch
):
    from filter_service.planning.plan import NodePlanner
    from filter_service.rendering.native import NativeRenderer

    pupil_mm, focus_dpt = STATES[0]["pupil_diameter_mm"], STATES[0]["focus_dpt"]
    store = PsfStore(*streamed)
    first = state_nodes(store, State(pupil_mm, focus_dpt))
    ahead = list(PsfStore(*streamed).planned_ahead(first))
    n_pupils, n_used = store.plan.group_shape[:2]
    assert len(ahead) == len({state for state, _ in ahead}) == n_pupils * n_used
    frame_layers(store, State(pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt))
    for part in ahead:
        store.take(pickle.loads(pickle.dumps(part)))
    monkeypatch.setattr(NodePlanner, "nodes", None)  # nothing is left to plan
    assert pictures(NativeRenderer(), store, frames(views)) == alone
    near = PsfStore(*streamed)
    for part in ahead[:4]:  # those around the state come first
        near.take(part)
    frame_layers(near, State(pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt))


@pytest.mark.long("a process plans two eyes")
def test_the_worker_plans_ahead_until_it_is_asked_for_something_else(monkeypatch):
    from filter_service.planning.plan import NodePlanner

    worker = WorkerHandle()
    job = BuildJob(
        profile=parse_profile({"kind": "prescription", "sphere_dpt": -2.0}),
        settings=FilterSettings(
            pupil_range_mm=(2.0, 7.0),
            focus_range_dpt=(0, 4),
            object_range_dpt=(0.0, 2.0),
        ),
        camera=Camera(32, 18, (-0.02, 0.02, 0.01, -0.01)),
        near=State(4.0, 2.0),
    )
    try:
        worker.start()
        stores, parts, deadline_s = {}, [], time.monotonic() + 60.0
        tickets = [worker.submit(job)]
        while len(stores) < 2 or parts[-1].ticket != tickets[1]:
            assert time.monotonic() < deadline_s
            for event in worker.poll():
                assert not isinstance(event, BuildError), event
                if isinstance(event, BuildDone):
                    store = stores[event.ticket] = event.built.store
                    nodes = {state for state, _ in event.built.parts}
                    assert nodes == set(state_nodes(store, job.near))
                elif isinstance(event, BuildPart):
                    parts.append(event)
            if stores and len(tickets) == 1 and parts:
                tickets.append(worker.submit(job))
            time.sleep(0.001)
        near, of_near = State(6.9, 0.1), []
        worker.plan_near(tickets[0], near)  # the earlier store
        while not of_near:
            assert time.monotonic() < deadline_s
            of_near += [e for e in worker.poll() if isinstance(e, BuildPart)]
            of_near = [part for part in of_near if part.ticket == tickets[0]]
            time.sleep(0.001)
    finally:
        worker.close()
    assert of_near[0].part[0] in state_nodes(stores[tickets[0]], near)
    n_states = np.prod(stores[tickets[0]].plan.group_shape[:2])
    of_first = [part for part in parts if part.ticket == tickets[0]]
    assert 0 < len(of_first) < n_states
    monkeypatch.setattr(NodePlanner, "nodes", None)  # stores do not plan themselves
    for part in parts:
        store = stores[part.ticket]
        store.take(part.part)
        store.groups_of([part.part[0]])


def test_a_frame_is_the_same_on_one_thread(streamed, views, alone):
    from estimator.native import core
    from estimator.psf.compiled import CompiledPsfs
    from filter_service.psfs.compute_kernels import psf_engine
    from filter_service.psfs.native_psfs import NativePsfs
    from filter_service.rendering.native import NativeRenderer

    threads = core().new_threads(1)
    own = NativePsfs(CompiledPsfs(core(), threads))
    store = PsfStore(*streamed, engine=replace(psf_engine(), native=own))
    found = pictures(NativeRenderer(n_threads=1), store, frames(views))
    core().end_threads(threads)
    assert found == alone


def test_a_frame_is_the_same_with_every_psf_computed_before(known, views, alone):
    from filter_service.rendering.native import NativeRenderer

    eye, spec, plan = known
    whole = build_psf_store(eye, spec, plan=plan)
    assert whole.computed_count == whole.psf_count
    assert pictures(NativeRenderer(), whole, frames(views)) == alone


def test_a_frame_is_the_same_when_its_psfs_were_evicted(streamed, views, alone):
    from filter_service.rendering.native import NativeRenderer

    eye, spec, plan = streamed
    store, renderer = PsfStore(eye, spec, plan), NativeRenderer()
    handle = renderer.load(store)
    for (view, state), expected in zip(frames(views), alone, strict=True):
        store.frame_number += 1  # so that nothing is of the current frame
        store.evict(0)
        assert store.computed_count == 0
        seen = renderer.render(view, handle, **state, output="srgb8")
        assert seen.color.tobytes() == expected
    assert store.generation == len(alone) - 1  # the first time there was nothing


@pytest.mark.gl
def test_the_gl_engine_shows_the_same_after_any_others(streamed, views, gpu):
    from filter_service.rendering.gl import FilterRenderer

    asked = [(view, STATES[k]) for view in views[:2] for k in (0, 2)]

    def colors(order):
        renderer = FilterRenderer(gpu)
        handle = renderer.load(PsfStore(*streamed))
        found = [renderer.render(v, handle, **s).color.copy() for v, s in order]
        handle.release()
        return found

    forward, backward = colors(asked), colors(asked[::-1])[::-1]
    for one, other in zip(forward, backward, strict=True):
        assert psnr_db(one, other) >= 100.0


def test_kernels_do_not_depend_on_what_is_computed_with_them(known):
    eye, spec, plan = known
    together, one_by_one = PsfStore(eye, spec, plan), PsfStore(eye, spec, plan)
    rng = np.random.default_rng(5)
    some = np.sort(rng.choice(together.psf_count, 60, replace=False))
    together.fill(some)
    for psf in rng.permutation(some):
        one_by_one.fill(np.array([psf]))
    for psf in some:
        assert kernel_of(together, psf) == kernel_of(one_by_one, psf)
    for name in ("spread_px", "peak_ratio", "radius_px"):
        np.testing.assert_array_equal(
            getattr(together, name), getattr(one_by_one, name), err_msg=name
        )


def kernel_of(store, psf):
    width, height = store.box_sizes_of(np.array([psf]))
    start = int(store.offsets[psf])
    return store.kernels[start : start + int((width * height)[0])].tobytes()


def test_only_what_a_frame_reads_is_computed(known, views):
    from filter_service.rendering.native import NativeRenderer

    store, renderer = PsfStore(*known), NativeRenderer()
    handle = renderer.load(store)
    renderer.render(views[1], handle, **STATES[0])
    first = store.computed_count
    assert 0 < first < 0.5 * store.psf_count
    seen = renderer.render(views[1], handle, **STATES[0])
    assert store.computed_count == first
    assert "psf_compute_ms" not in seen.stage_times_ms


def test_a_frame_without_time_says_so_and_the_next_goes_on(known, views, alone):
    from filter_service.rendering.native import NativeRenderer

    store, renderer = PsfStore(*known), NativeRenderer()
    handle = renderer.load(store)
    view, state = frames(views)[0]
    counts = []
    for _ in range(1000):
        seen = renderer.render(
            view, handle, **state, output="srgb8", until_s=time.monotonic()
        )
        if not isinstance(seen, MissingPsfs):
            break
        assert not store.tables.is_computed[seen.psfs].any()
        counts.append(store.computed_count)
    assert seen.color.tobytes() == alone[0]
    assert counts == sorted(set(counts))


def test_memory_is_limited(streamed, views):
    from filter_service.rendering.native import NativeRenderer

    eye, spec, plan = streamed
    renderer = NativeRenderer()
    whole = PsfStore(eye, spec, plan)
    pictures(renderer, whole, frames(views))
    limit_mb = 0.8 * whole.memory_mb
    small = PsfStore(eye, replace(spec, memory_budget_mb=limit_mb), plan)
    handle = renderer.load(small)
    for view, state in frames(views[:2]):
        renderer.render(view, handle, **state)
        assert small.memory_mb <= limit_mb
    assert small.generation > 0
    tiny = PsfStore(eye, replace(spec, memory_budget_mb=0.001), plan)
    with pytest.raises(OutOfMemory, match="one frame need"):
        renderer.render(views[0], renderer.load(tiny), **STATES[0])


def test_layers_do_not_depend_on_computed_psfs(known):
    eye, spec, plan = known
    empty, whole = PsfStore(eye, spec, plan), build_psf_store(eye, spec, plan=plan)
    for state in STATES:
        state = {k: state[k] for k in ("pupil_diameter_mm", "focus_dpt")}
        one, other = (frame_layers(store, State(**state)) for store in (empty, whole))
        np.testing.assert_array_equal(one.layer_dpt, other.layer_dpt)


def test_the_blur_of_nodes_is_that_of_their_psfs(known):
    """Against the survey of each wavefront: other rays, other wavelengths."""
    eye, spec, plan = known
    store = PsfStore(eye, spec, plan)
    some = np.arange(0, store.psf_count, 37)
    states = states_of(spec, plan, some // 3, some % 3)
    surveyed_px = state_survey(eye, spec, states).blur_radius_px
    found_px = store.blur_px[some]
    assert np.all(np.abs(found_px - surveyed_px) <= 0.15 * surveyed_px + 0.5)


def test_the_wavefronts_of_nodes_are_the_eyes(known):
    store = PsfStore(*known)
    some = np.arange(0, store.psf_count, 101)
    states = states_of(store.spec, store.plan, some // 3, some % 3)
    truth = store.eye.wavefronts(**vars(states))
    groups = store.nodes.defocus.group_at(some // 3)
    found = store.nodes.wavefronts.at(groups, some % 3, states.total_defocus_dpt)
    np.testing.assert_allclose(found.zernike_um, truth.zernike_um, atol=1e-12)
    np.testing.assert_allclose(found.pupil_ellipse, truth.pupil_ellipse, atol=1e-12)


def test_what_is_computed_ahead_is_what_the_frame_needs(streamed, views):
    from filter_service.rendering.native import NativeRenderer

    for view, state in frames(views[:1]):
        state = {k: state[k] for k in ("pupil_diameter_mm", "focus_dpt")}
        store, renderer = PsfStore(*streamed), NativeRenderer()
        handle = renderer.load(store)
        seen = (SampledView.later(view)(),)
        use = SampledFrame(0.0, State(**state), lambda seen=seen: seen)
        ahead = handle.missing_psfs(use)
        store.fill(ahead)
        assert store.computed_count == ahead.size
        renderer.render(view, handle, **state)
        assert store.computed_count <= 1.15 * ahead.size


def sampled(view, *, at_s=0.0, **state):
    state = State(state["pupil_diameter_mm"], state["focus_dpt"])
    seen = (SampledView.later(view)(),)
    return SampledFrame(at_s, state, lambda: seen)


@pytest.mark.parametrize("is_beside_a_frame", [False, True])
def test_psfs_computed_beside_frames_are_the_same(
    streamed, views, alone, is_beside_a_frame
):
    from filter_service.rendering.native import NativeRenderer

    store, renderer, lock = PsfStore(*streamed), NativeRenderer(), PriorityLock()
    handle, (view, state) = renderer.load(store), frames(views)[0]
    missing = handle.missing_psfs(sampled(view, **state))
    work = PsfWork(handle, missing)
    with lock.foreground() if is_beside_a_frame else nullcontext():
        work.compute(lock, lambda: False)
    assert work.left.size == (0 if is_beside_a_frame else missing.size - BATCH)
    assert store.computed_count == 0, "the store was changed without the lock"
    store.fill(missing[::2])  # by a frame
    while work.left.size or work.done:
        work.add()
        work.compute(lock, lambda: False)
    assert store.computed_count == missing.size
    whole = PsfStore(*streamed)
    renderer.load(whole).missing_psfs(sampled(view, **state))
    whole.fill(missing)
    assert store.memory_mb == whole.memory_mb
    for psf in missing[::7]:
        assert kernel_of(store, psf) == kernel_of(whole, psf)
    seen = renderer.render(view, handle, **state, output="srgb8")
    assert seen.color.tobytes() == alone[0]


def test_a_frame_may_compute_the_last_psfs(streamed, views):
    from filter_service.rendering.native import NativeRenderer

    handle, lock = NativeRenderer().load(PsfStore(*streamed)), PriorityLock()
    missing = handle.missing_psfs(sampled(views[1], **STATES[0]))
    work = PsfWork(handle, missing, enough=missing.size - BATCH - 1)
    with lock.foreground():
        work.compute(lock, lambda: False)
    assert work.left.size == missing.size - 2 * BATCH
    assert work.is_enough


def test_an_error_of_psfs_is_raised_when_they_are_added(streamed, views, monkeypatch):
    from filter_service.rendering.native import NativeRenderer

    handle = NativeRenderer().load(PsfStore(*streamed))
    work = PsfWork(handle, handle.missing_psfs(sampled(views[0], **STATES[0])))

    def fail(*_, **__):
        raise BuildFailed("no light")

    monkeypatch.setattr(PsfStore, "computed", fail)
    work.compute(PriorityLock(), lambda: False)
    with pytest.raises(BuildFailed, match="no light"):
        work.add()


def test_work_that_is_due_later_is_spread_over_frames(streamed, views, monkeypatch):
    from filter_service.rendering.native import NativeRenderer

    handle, lock = NativeRenderer().load(PsfStore(*streamed)), PriorityLock()
    clock = SimpleNamespace(now_s=0.0)
    clock.monotonic = lambda: clock.now_s
    clock.sleep = lambda pause_s: setattr(clock, "now_s", clock.now_s + pause_s)
    monkeypatch.setattr(psf_work, "time", clock)
    missing = handle.missing_psfs(sampled(views[1], **STATES[0]))[:512]
    work = PsfWork(handle, missing, due_s=0.15)
    with lock.foreground():
        work.compute(lock, lambda: False)
    assert len(work.done) == missing.size / SPREAD_BATCH == 8
    assert clock.now_s == pytest.approx(0.15, abs=8 * PAUSE_S)


def test_a_new_frame_interrupts_work_for_predicted_ones(streamed, views):
    from filter_service.rendering.native import NativeRenderer

    handle, lock = NativeRenderer().load(PsfStore(*streamed)), PriorityLock()
    missing = handle.missing_psfs(sampled(views[1], **STATES[0]))
    history = FrameHistory()
    work = PsfWork(handle, missing, time.monotonic(), history=history)
    history.record(views[:1], State(4.0, 0.0), at_s=0.0)
    with lock.foreground():
        work.compute(lock, lambda: False)
        assert not work.done
        history.last_predicted = history.last
        work.compute(lock, lambda: False)
    assert not work.left.size


def test_a_predicted_state_between_other_nodes_finds_its_psfs_computed(streamed, views):
    """A pupil that opens reads another node after the last frame, and only then."""
    from filter_service.rendering.native import NativeRenderer

    store, renderer = PsfStore(*streamed), NativeRenderer()
    handle, focus_dpt = renderer.load(store), 0.3
    nodes_mm = store.plan.pupils_mm
    pupils_mm = nodes_mm[1] - np.array([0.06, 0.03, -0.03])
    history, known_nodes = FrameHistory(), PredictedNodes()
    for number, pupil_mm in enumerate(pupils_mm[:2].tolist()):
        state = State(pupil_mm, focus_dpt)
        history.record([views[0]], state, at_s=0.1 * number)
        renderer.render(
            views[0], handle, pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt
        )
    asked = []

    def predict():
        return predicted_work(handle, history, known_nodes, asked.append, is_busy=True)

    assert predict() is None, "states are planned by the worker"
    for part in PsfStore(*streamed).planned_ahead(state_nodes(store, asked[0])):
        store.take(part)
    history.record([views[0]], state, at_s=0.11)
    before = store.computed_count
    work = predict()
    while work.left.size:
        work.compute(PriorityLock(), lambda: False)
    work.add()
    n_ahead = store.computed_count - before
    assert n_ahead > BATCH
    renderer.render(
        views[0], handle, pupil_diameter_mm=pupils_mm[2], focus_dpt=focus_dpt
    )
    assert store.computed_count - before <= 1.1 * n_ahead


def test_a_new_eye_takes_over_the_arrays_of_a_released_one(streamed, views, alone):
    from filter_service.rendering.native import NativeRenderer

    renderer, (view, state) = NativeRenderer(), frames(views)[0]
    first = renderer.load(PsfStore(*streamed))
    renderer.render(view, first, **state)
    arrays = renderer._eyes.of(first).arrays
    second = renderer.load(PsfStore(*streamed))
    assert renderer._eyes.of(second).arrays is not arrays
    first.release()
    third = renderer.load(PsfStore(*streamed))
    seen = renderer.render(view, third, **state, output="srgb8")
    assert seen.color.tobytes() == alone[0]
    assert renderer._eyes.of(third).arrays is arrays


def test_a_first_frame_is_guessed(known):
    eye, spec, plan = known
    from filter_service.rendering.native import NativeRenderer

    handle = NativeRenderer().load(PsfStore(eye, spec, plan))
    use = first_frame(spec.camera, FilterSettings(pupil_range_mm=(5.0, 6.0)))
    assert use.state.pupil_diameter_mm == 5.0
    assert 0 < handle.missing_psfs(use).size < handle.missing_psfs().size


def test_another_state_may_be_planned_while_a_frame_computes_psfs(streamed):
    """In a pause, by the thread that prepares eyes: the tables are replaced."""
    from filter_service.rendering.image_cells import image_cells

    eye, spec, plan = streamed
    store = PsfStore(eye, spec, plan)
    layers = frame_layers(store, State(pupil_diameter_mm=4.0, focus_dpt=0.0))
    image = image_cells(spec, plan)
    used = np.ones((image.count, interval_count(layers)), bool)
    others = [(k, 0) for k in range(len(plan.pupils_mm))][::-1]

    def fill(psfs):
        store.groups_of([others.pop(0)])
        return store.fill(psfs)

    found = frame_kernels(store, layers, image, used, fill=fill)
    assert found.count == used.sum()
    assert len(others) == len(plan.pupils_mm) - 1, "the PSFs were not found"


def test_a_plan_without_time_asks_for_what_it_lacks(known):
    eye, spec, plan = known
    store = PsfStore(eye, spec, plan)
    layers = frame_layers(store, State(pupil_diameter_mm=4.0, focus_dpt=0.0))
    from filter_service.rendering.image_cells import image_cells

    image = image_cells(spec, plan)
    used = np.zeros((image.count, interval_count(layers)), bool)
    used[0, 0] = True
    asked = []

    def fill(psfs):
        asked.append(psfs)
        return store.fill(psfs)

    frame_kernels(store, layers, image, used, fill=fill)
    assert len(asked) == 1
    assert asked[0].size == store.computed_count
    frame_kernels(store, layers, image, used, fill=fill)
    assert len(asked) == 1


def test_what_a_computation_refuses_is_an_error_of_the_service(known, monkeypatch):
    from filter_service.psfs import compute_kernels

    def fail(*_):
        raise ValueError("PSF 3 has no light within 7 px of the chief ray")

    store = PsfStore(*known)
    monkeypatch.setattr(compute_kernels, "computed_kernels", fail)
    with pytest.raises(BuildFailed, match="no light within 7 px") as caught:
        store.fill(np.arange(4))
    assert caught.value.field == "settings"
    assert caught.value.allowed
    assert store.computed_count == 0


def test_nothing_moves_where_there_is_nothing_to_evict(known):
    store = PsfStore(*known)
    store.fill(np.arange(0, 300, 7))
    store.evict(store.kernels.size)
    assert store.generation == 0


def test_all_ranges_that_do_not_fit_are_refused(known):
    from filter_service.rendering.native import NativeRenderer

    store = PsfStore(*known)
    handle = NativeRenderer().load(store)
    assert handle.missing_psfs().size == store.psf_count
    store.fill(np.arange(60))
    store.frame_number += 1
    store.evict(0)
    with pytest.raises(OutOfMemory, match="all ranges"):
        handle.missing_psfs()
