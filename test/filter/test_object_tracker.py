"""One object followed by the contacts of several sensors: its belief, its frame, what they do not claim."""

import numpy as np
import pytest
from fusion_cases import extreme_covariance, extreme_mean
from scipy.stats import chi2

from tactile_base.settings import SettingError
from tactile_filter.consistency import nees
from tactile_filter.object.belief import Contact, fuse_contacts, object_from_contact
from tactile_filter.object.merge import EventMerge
from tactile_filter.object.settings import PlaceSettings, TrackerSettings
from tactile_filter.object.tracker import ContactUpdate, ObjectTracker, may_slide, shear_ratio
from tactile_filter.propagation import predict
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

MS = 1_000_000
STEP = 16 * MS
START = 1_700_000_000_000_000_000
SIGMA = np.array([3e-4, 3e-4, 1e-4, 6e-3, 6e-3, 1.5e-2])
COV = np.diag(SIGMA**2)
ZERO = np.zeros((6, 6))
OBJECT = se3.exp([0.5, 0.1, 0.2, 0.1, -0.3, 1.0])
# a box, 60 mm wide, held from three sides
FEATURES = {
    "back": se3.pose_from_euler([0.03, 0.0, 0.0, 0.0, -np.pi / 2, 0.0]),
    "left": se3.pose_from_euler([0.0, 0.03, 0.0, np.pi / 2, 0.0, 0.0]),
    "right": se3.pose_from_euler([0.0, -0.03, 0.0, -np.pi / 2, 0.0, 0.0]),
}
CONTACTS = {
    "back": se3.exp([0, 0, -4e-3, 0, 0.05, 0]),
    "left": se3.exp([1e-3, 0, -3e-3, 0.1, 0, 0]),
    "right": se3.exp([0, 1e-3, -2e-3, 0, 0.1, 0.05]),
}
GIVEN = {name: PoseGaussian(T, ZERO) for name, T in FEATURES.items()}


def given(*names) -> dict[str, PoseGaussian]:
    return {name: GIVEN[name] for name in names}


def update(name, error=None, T_wo=OBJECT, cov=COV) -> ContactUpdate:
    """What a sensor that touches the object at its feature believes, with an error (6,) on the left."""
    X_sf = CONTACTS[name]
    sensor = T_wo @ FEATURES[name] @ se3.inverse(X_sf)
    return ContactUpdate(PoseGaussian(X_sf if error is None else se3.exp(error) @ X_sf, cov), sensor)


def tracker_of(*names, places=None, **settings) -> ObjectTracker:
    return ObjectTracker(names, TrackerSettings(**settings), places)


def error(rng) -> np.ndarray:
    return SIGMA * rng.normal(size=6)


def bounds(runs: int) -> tuple[float, float]:
    return tuple(chi2.ppf((0.0005, 0.9995), 6 * runs) / runs)


# ---- what is fused ----


def test_contacts_at_given_places_and_one_stamp_are_fused_as_the_library_does():
    rng = np.random.default_rng(1)
    tracker = tracker_of("left", "right", places=given("left", "right"))
    updates = {name: update(name, error(rng)) for name in ("left", "right")}
    found = tracker.step(START, updates)
    contacts = {n: Contact(u.belief, u.T_world_sensor, GIVEN[n]) for n, u in updates.items()}
    known = {name: object_from_contact(contact) for name, contact in contacts.items()}
    expected = fuse_contacts(known, 0.999999)
    np.testing.assert_allclose(found.belief.pose.mean, expected.pose.mean, atol=1e-13)
    np.testing.assert_allclose(found.belief.pose.cov, expected.pose.cov, rtol=1e-9)
    assert sorted(found.belief.used) == ["left", "right"] and not found.reason


@pytest.mark.parametrize("names", [("left", "right"), ("back", "left", "right")])
def test_independent_contacts_at_given_places_are_as_certain_as_they_claim(names):
    rng = np.random.default_rng(2)
    total, runs = 0.0, 150
    for _ in range(runs):
        tracker = tracker_of(*names, places=given(*names))
        pose = tracker.step(START, {name: update(name, error(rng)) for name in names}).belief.pose
        total += nees(OBJECT, pose.mean, pose.cov)
    low, high = bounds(runs)
    assert low < total / runs < high
    alone = tracker_of("left", places=given("left")).step(START, {"left": update("left")}).belief.pose
    assert np.linalg.slogdet(pose.cov)[1] < np.linalg.slogdet(alone.cov)[1] - 2.0


def test_a_given_place_that_is_not_exact_makes_the_object_less_certain_by_that():
    rng = np.random.default_rng(3)
    sigma = np.array([2e-3, 2e-3, 1e-4, 1e-3, 1e-3, 1e-2])
    total, runs = 0.0, 150
    for _ in range(runs):
        places = {}
        for name in ("left", "right"):
            wrong = FEATURES[name] @ se3.exp(sigma * rng.normal(size=6))
            pose = tuple(se3.euler_from_pose(wrong))
            places[name] = PlaceSettings(given=True, pose=pose, sigma=tuple(sigma)).place()
        tracker = tracker_of("left", "right", places=places)
        found = tracker.step(START, {name: update(name, error(rng)) for name in places}).belief.pose
        total += nees(OBJECT, found.mean, found.cov)
    low, high = bounds(runs)
    assert low < total / runs < high


# ---- places found by touch ----


def test_the_first_contact_defines_the_objects_frame_if_no_place_is_given():
    tracker = tracker_of("left", "right")
    first = update("right")
    found = tracker.step(START, {"right": first})
    np.testing.assert_allclose(found.belief.pose.mean, first.T_world_sensor @ first.belief.mean, atol=1e-13)
    np.testing.assert_allclose(
        found.belief.pose.cov, object_from_contact(Contact(*first, PoseGaussian(np.eye(4), ZERO))).cov
    )


def test_of_two_first_contacts_the_earlier_one_and_of_equals_the_name_decides():
    tracker = tracker_of("left", "right")
    found = tracker.step(START, {name: update(name) for name in ("right", "left")})
    assert found.belief.used == ("left",) and found.unplaced == ("right",)
    np.testing.assert_allclose(found.belief.pose.mean, OBJECT @ FEATURES["left"], atol=1e-13)


def test_a_second_contact_is_placed_by_the_objects_belief_and_carries_it_on():
    tracker = tracker_of("left", "right")
    tracker.step(START, {"left": update("left")})
    frame = OBJECT @ FEATURES["left"]
    assert tracker.step(START + STEP, {n: update(n) for n in ("left", "right")}).unplaced == ("right",)
    both = tracker.step(START + 2 * STEP, {n: update(n) for n in ("left", "right")})
    assert sorted(both.belief.used) == ["left", "right"]
    moved = se3.exp([0.1, 0.0, 0.0, 0.0, 0.0, 0.5]) @ OBJECT
    alone = tracker.step(START + 3 * STEP, {"left": None, "right": update("right", T_wo=moved)})
    assert alone.belief.used == ("right",)
    np.testing.assert_allclose(alone.belief.pose.mean, moved @ se3.inverse(OBJECT) @ frame, atol=1e-12)


def held_on(rng, lasting: bool):
    """The object with two contacts, then without the first, and the truth; errors stay, or are new ones."""
    tracker = tracker_of("left", "right")
    errors = {"left": error(rng), "right": error(rng)}
    for k in range(3):
        if not lasting:
            errors = {"left": error(rng), "right": error(rng)}
        found = tracker.step(START + k * STEP, {n: update(n, e) for n, e in errors.items()})
    both = found.belief.pose
    last = errors["right"] if lasting else error(rng)
    alone = tracker.step(START + 3 * STEP, {"left": None, "right": update("right", last)}).belief.pose
    return both, alone, OBJECT @ FEATURES["left"]


@pytest.mark.parametrize("lasting", [True, False])
def test_a_place_that_was_found_makes_the_object_no_more_certain_than_it_is(lasting):
    rng = np.random.default_rng(4)
    totals, runs = np.zeros(2), 100
    for _ in range(runs):
        both, alone, truth = held_on(rng, lasting)
        totals += nees(truth, both.mean, both.cov), nees(truth, alone.mean, alone.cov)
    low, high = bounds(runs)
    assert (totals / runs < high).all()
    if not lasting:
        assert low < totals[1] / runs  # independent throughout: not pessimistic either


def test_the_certainty_does_not_grow_by_passing_the_object_from_hand_to_hand():
    """Each sensor in turn lets go and touches again: every place is found by those that hold."""
    rng = np.random.default_rng(5)
    names, runs, rounds = ("back", "left", "right"), 60, 4
    totals, sizes = np.zeros(rounds), np.zeros((runs, rounds))
    for run in range(runs):
        tracker = tracker_of(*names)
        errors = {name: error(rng) for name in names}
        stamp_ns = START
        tracker.step(stamp_ns, {"back": update("back", errors["back"])})
        for k in range(rounds):
            leaving = names[k % 3]
            for updates in (
                {name: update(name, e) for name, e in errors.items()},
                {name: None if name == leaving else update(name, e) for name, e in errors.items()},
            ):
                stamp_ns += STEP
                found = tracker.step(stamp_ns, updates)
            errors[leaving] = error(rng)
            pose = found.belief.pose
            assert leaving not in found.belief.used
            totals[k] += nees(OBJECT @ FEATURES["back"], pose.mean, pose.cov)
            sizes[run, k] = np.linalg.slogdet(pose.cov)[1]
    assert (totals / runs < bounds(runs)[1]).all()
    assert (np.diff(sizes.mean(axis=0)) > -1e-6).all()


def test_a_contact_that_ended_has_no_place_when_it_begins_anew():
    tracker = tracker_of("left", "right")
    for k in range(3):
        tracker.step(START + k * STEP, {n: update(n) for n in ("left", "right")})
    tracker.step(START + 3 * STEP, {"left": update("left"), "right": None})
    found = tracker.step(START + 4 * STEP, {n: update(n) for n in ("left", "right")})
    assert found.unplaced == ("right",)


def test_when_nothing_touches_the_object_it_is_forgotten():
    tracker = tracker_of("left", "right")
    tracker.step(START, {"left": update("left")})
    nothing = tracker.step(START + STEP, {"left": None})
    assert nothing.belief.pose is None and nothing.reason == "no contact"
    again = tracker.step(START + 2 * STEP, {"right": update("right")})
    np.testing.assert_allclose(again.belief.pose.mean, OBJECT @ FEATURES["right"], atol=1e-13)


def test_where_a_place_is_given_no_other_contact_defines_the_frame():
    tracker = tracker_of("left", "right", places=given("left"))
    waiting = tracker.step(START, {"right": update("right")})
    assert waiting.belief.pose is None and waiting.unplaced == ("right",)
    assert waiting.reason == "no contact whose place on the object is known"
    tracker.step(START + STEP, {n: update(n) for n in ("left", "right")})
    found = tracker.step(START + 2 * STEP, {"left": None, "right": update("right")})
    np.testing.assert_allclose(found.belief.pose.mean, OBJECT, atol=1e-12)


# ---- time ----


def test_an_older_contact_is_taken_to_the_newest_stamp_as_the_filter_would_predict_it():
    """The sensor moves on over an object that stands still; what the object may have moved is added."""
    tracker = tracker_of("left", places=given("left"), object_speed=0.1, object_turn_rate=0.5)
    late = update("left", SIGMA)
    tracker.step(START, {"left": late})
    found = tracker.step(START + STEP, {})
    sensor_now = late.T_world_sensor @ se3.exp([2e-3, 0.0, 1e-3, 0.0, 0.1, 0.0])
    moved = (np.repeat((0.1, 0.5), 3) * STEP * 1e-9) ** 2
    mean, cov = predict(late.belief.mean, late.belief.cov, late.T_world_sensor, sensor_now, np.zeros(6))
    at_once = object_from_contact(Contact(PoseGaussian(mean, cov), sensor_now, GIVEN["left"]))
    np.testing.assert_allclose(found.belief.pose.mean, at_once.mean, atol=1e-13)
    to_sensor = se3.adjoint(se3.inverse(late.T_world_sensor))
    added = to_sensor @ (found.belief.pose.cov - at_once.cov) @ to_sensor.T
    np.testing.assert_allclose(added, np.diag(moved), atol=1e-12)


@pytest.mark.parametrize("allowed", [True, False])
def test_the_motion_between_stamps_is_in_the_covariance(allowed):
    rng = np.random.default_rng(6)
    speed, turn_rate, age = 0.2, 1.0, 8 * MS
    settings = {"object_speed": speed, "object_turn_rate": turn_rate} if allowed else dict.fromkeys(
        ("object_speed", "object_turn_rate"), 0.0
    )  # fmt: skip
    total, runs = 0.0, 150
    for _ in range(runs):
        tracker = tracker_of("left", "right", places=given("left", "right"), gate_probability=1.0, **settings)
        twist = np.repeat((speed, turn_rate), 3) * rng.normal(size=6)
        now = OBJECT @ se3.exp(twist * age * 1e-9)
        tracker.step(START, {"left": update("left", error(rng))})
        found = tracker.step(START + age, {"right": update("right", error(rng), T_wo=now)}).belief.pose
        total += nees(now, found.mean, found.cov)
    high = bounds(runs)[1]
    assert total / runs < high if allowed else total / runs > 1.2 * high


def test_a_contact_that_is_too_old_is_left_out_by_name_and_counts_again_when_it_is_back():
    tracker = tracker_of("left", "right", places=given("left", "right"), max_age=0.05)
    tracker.step(START, {n: update(n) for n in ("left", "right")})
    found = tracker.step(START + 60 * MS, {"left": update("left")})
    assert found.belief.used == ("left",) and found.stale == {"right": pytest.approx(0.06)}
    found = tracker.step(START + 80 * MS, {"right": update("right")})
    assert sorted(found.belief.used) == ["left", "right"] and not found.stale


def test_a_contact_that_was_silent_for_too_long_has_ended():
    tracker = tracker_of("left", "right", forget_after=0.2)
    for k in range(3):
        tracker.step(START + k * STEP, {n: update(n) for n in ("left", "right")})
    for k in range(1, 16):
        found = tracker.step(START + 2 * STEP + k * STEP, {"left": update("left")})
    assert not found.stale
    found = tracker.step(START + 20 * STEP, {n: update(n) for n in ("left", "right")})
    assert found.unplaced == ("right",), "its place is not what it was"


def test_an_update_that_is_not_later_than_its_sensors_last_one_is_refused_and_counted():
    tracker = tracker_of("left", places=given("left"))
    tracker.step(START, {"left": update("left")})
    tracker.step(START, {"left": update("left", 10 * SIGMA)})
    tracker.step(START - STEP, {"left": None})
    assert tracker.refused["out of order"] == 2
    found = tracker.step(START + STEP, {})
    np.testing.assert_allclose(found.belief.pose.mean, OBJECT, atol=1e-13)


def test_a_sensor_that_was_overtaken_counts_but_nothing_is_told_backwards():
    tracker = tracker_of("left", "right", places=given("left", "right"))
    tracker.step(START, {"left": update("left")})
    assert tracker.step(START - 4 * MS, {"right": update("right")}) is None
    assert sorted(tracker.step(START + STEP, {}).belief.used) == ["left", "right"]


def test_the_order_in_which_sensors_arrive_changes_no_bit():
    rng = np.random.default_rng(7)
    names = ("back", "left", "right")
    events = {
        name: [(START + offset + k * STEP, update(name, error(rng))) for k in range(12)]
        for name, offset in zip(names, (0, 5 * MS, 5 * MS), strict=True)
    }
    events["left"][5] = events["left"][5][0], None
    found_beliefs = []
    for _ in range(3):
        merge, tracker, results = EventMerge(names), tracker_of(*names), []
        for name in names:
            merge.add(name, START - STEP, None, 0)
        waiting = {name: list(each) for name, each in events.items()}
        while any(waiting.values()):
            name = rng.choice([n for n in names if waiting[n]])
            stamp_ns, what = waiting[name].pop(0)
            merge.add(name, stamp_ns, what, 0)
            results += [tracker.step(g.stamp_ns, g.parts) for g in merge.take(0, STEP, STEP)]
        poses = [found.belief.pose for found in results]
        found_beliefs.append(b"".join(p.mean.tobytes() + p.cov.tobytes() for p in poses if p is not None))
        assert len(results) > 20
    assert found_beliefs[0] == found_beliefs[1] == found_beliefs[2]


# ---- contacts that slide ----


def sheared(name, ratio, along=0.0) -> ContactUpdate:
    """A contact 3 mm deep with that shear over its depth, its feature frame dragged `along` m so far."""
    X_sf = se3.exp([-3e-3 * ratio, 0, -3e-3, 0, 0, 0])
    feature = OBJECT @ FEATURES[name] @ se3.exp([along, 0, 0, 0, 0, 0])
    return ContactUpdate(PoseGaussian(X_sf, COV), feature @ se3.inverse(X_sf))


def test_the_shear_of_a_contact_is_told_as_part_of_its_depth():
    assert shear_ratio(sheared("left", 0.7).belief.mean) == pytest.approx(0.7)
    tilted = se3.inverse(se3.pose_from_euler([1e-3, 2e-3, 4e-3, 0.2, -0.1, 0.3]))
    assert shear_ratio(tilted) == pytest.approx(np.sqrt(5.0) / 4.0)
    assert shear_ratio(se3.exp([0, 0, 1e-3, 0, 0, 0])) == np.inf  # off the surface


def test_a_light_touch_that_is_sheared_by_no_more_than_its_noise_does_not_slide():
    light = PoseGaussian(se3.exp([2e-4, 0, -1e-4, 0, 0, 0]), np.diag(np.square([5e-4, 5e-4, 1e-4, 0, 0, 0])))
    assert not may_slide(light, 0.7, slides=False)
    assert may_slide(PoseGaussian(light.mean, 1e-3 * light.cov), 0.7, slides=False)


@pytest.mark.parametrize("axis", [0, 1])
def test_how_certain_a_slip_is_counts_along_the_shear(axis):
    """In the frame of the surface: here the sensor is turned by 90 degrees about its axis."""
    sigma = np.array([1e-5, 1e-5, 1e-5, 0, 0, 0])
    sigma[axis] = 1e-3
    X_sf = se3.inverse(se3.pose_from_euler([0, 3e-3, 3e-3, 0, 0, np.pi / 2]))
    sheared_along = 0  # the sensor's own x axis
    assert may_slide(PoseGaussian(X_sf, np.diag(sigma**2)), 0.7, slides=False) == (axis != sheared_along)


@pytest.mark.parametrize("places", [None, "given"])
def test_a_contact_that_slides_is_left_out_by_name_and_the_other_holds_the_object(places):
    tracker = tracker_of("left", "right", places=given("left", "right") if places else None)
    frame = OBJECT if places else OBJECT @ FEATURES["left"]
    for k in range(3):
        tracker.step(START + k * STEP, {name: sheared(name, 0.2) for name in ("left", "right")})
    for k in range(3, 30):
        left = sheared("left", 1.2, 1e-3 * (k - 2))
        found = tracker.step(START + k * STEP, {"left": left, "right": sheared("right", 0.3)})
        assert found.belief.used == ("right",) and found.sliding == {"left": pytest.approx(1.2)}
        np.testing.assert_allclose(found.belief.pose.mean, frame, atol=1e-9)


def test_a_contact_that_slid_is_placed_anew_where_its_shear_has_gone_back_for_good():
    tracker = tracker_of("left", "right", places=given("left", "right"))
    for k, ratio in enumerate((0.2, 0.2, 1.1, 0.45, 0.3, 0.3)):
        left = sheared("left", ratio, 0.02 if k > 2 else 0.0)
        found = tracker.step(START + k * STEP, {"left": left, "right": sheared("right", 0.2)})
        assert list(found.sliding) == (["left"] if k in (2, 3) else [])  # 0.45 is too near to the limit yet
        assert found.unplaced == (("left",) if k == 4 else ())
    assert sorted(found.belief.used) == ["left", "right"]
    np.testing.assert_allclose(found.belief.pose.mean, OBJECT, atol=1e-9)


def test_where_all_contacts_slide_nothing_is_told_until_one_sticks_and_defines_the_frame():
    tracker = tracker_of("left", "right")
    for k in range(3):
        tracker.step(START + k * STEP, {name: sheared(name, 0.2) for name in ("left", "right")})
    found = tracker.step(START + 3 * STEP, {name: sheared(name, 1.5) for name in ("left", "right")})
    assert found.belief.pose is None and found.reason == "all contacts may slide"
    update = sheared("right", 0.1)
    found = tracker.step(START + 4 * STEP, {"left": sheared("left", 1.5), "right": update})
    np.testing.assert_allclose(found.belief.pose.mean, update.T_world_sensor @ update.belief.mean, atol=1e-13)


def test_a_given_place_counts_again_with_the_next_contact():
    tracker = tracker_of("left", places=given("left"))
    tracker.step(START, {"left": sheared("left", 1.5)})
    found = tracker.step(START + STEP, {"left": sheared("left", 0.1)})
    assert found.reason == "no contact whose place on the object is known"
    tracker.step(START + 2 * STEP, {"left": None})
    found = tracker.step(START + 3 * STEP, {"left": sheared("left", 0.1)})
    np.testing.assert_allclose(found.belief.pose.mean, OBJECT, atol=1e-9)


@pytest.mark.parametrize("before", [(1.5,), (1.5, 0.2)])
def test_a_contact_that_slid_is_not_at_its_given_place_after_a_silence(before):
    tracker = tracker_of("left", places=given("left"), forget_after=0.2)
    for k, ratio in enumerate(before):
        tracker.step(START + k * STEP, {"left": sheared("left", ratio)})
    later = START + 60 * STEP
    assert tracker.step(later, {}).reason == "no contact"
    for k, ratio in enumerate((0.45, 0.3)):  # nothing says that it was off the object, and at its place again
        assert tracker.step(later + k * STEP + 1, {"left": sheared("left", ratio)}).belief.pose is None
    tracker.step(later + 9 * STEP, {"left": None})
    assert tracker.step(later + 10 * STEP, {"left": sheared("left", 0.1)}).belief.pose is not None


# ---- what is wrong ----


def slid(*, places=None, **settings):
    """Two contacts that agree, until the less certain one slides 12 mm, which its shear does not tell."""
    tracker = tracker_of("left", "right", places=places, slide_shear=0.0, **settings)
    for k in range(3):
        tracker.step(START + k * STEP, {"left": update("left"), "right": update("right", cov=2 * COV)})
    off = update("right", np.array([12e-3, 0, 0, 0, 0, 0]), cov=2 * COV)
    return tracker, off


@pytest.mark.parametrize("places", [None, "given"])
def test_a_contact_that_disagrees_is_refused_by_name(places):
    tracker, off = slid(places=given("left", "right") if places else None)
    found = tracker.step(START + 3 * STEP, {"left": update("left"), "right": off})
    assert found.belief.used == ("left",) and list(found.belief.refused) == ["right"]


def test_a_contact_that_slid_is_given_a_new_place_after_a_while():
    tracker, off = slid(replace_after=0.1)
    for k in range(3, 20):
        found = tracker.step(START + k * STEP, {"left": update("left"), "right": off})
    assert sorted(found.belief.used) == ["left", "right"]
    np.testing.assert_allclose(found.belief.pose.mean, OBJECT @ FEATURES["left"], atol=1e-6)


def test_a_given_place_stays_however_long_its_contact_disagrees():
    tracker, off = slid(places=given("left", "right"), replace_after=0.1)
    for k in range(3, 20):
        found = tracker.step(START + k * STEP, {"left": update("left"), "right": off})
    assert list(found.belief.refused) == ["right"]


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (ContactUpdate(PoseGaussian(np.full((4, 4), np.nan), COV), np.eye(4)), "not usable"),
        (ContactUpdate(PoseGaussian(np.eye(4), np.diag([1.0, 1, 1, 1, 1, -1])), np.eye(4)), "not usable"),
        (ContactUpdate(PoseGaussian(np.eye(4), COV), np.full((4, 4), np.nan)), "sensor pose"),
        (ContactUpdate(PoseGaussian(np.eye(4), COV), np.zeros((4, 4))), "sensor pose"),
    ],
)
def test_an_update_that_cannot_be_used_is_counted_and_the_contact_ages(bad, reason):
    tracker = tracker_of("left", places=given("left"))
    tracker.step(START, {"left": update("left")})
    found = tracker.step(START + STEP, {"left": bad})
    assert tracker.refused[reason] == 1
    np.testing.assert_allclose(found.belief.pose.mean, OBJECT, atol=1e-13)
    assert np.linalg.slogdet(found.belief.pose.cov)[1] > np.linalg.slogdet(COV)[1]
    assert tracker.step(START + 10 * STEP, {}).stale


def test_a_sensor_that_there_is_not_is_an_error_that_lists_those_there_are():
    tracker = tracker_of("left", "right")
    for call in (
        lambda: tracker.step(START, {"lefft": None}),
        lambda: tracker.set_place("lefft", None),
        lambda: tracker_of("left", "right", places={"lefft": GIVEN["left"]}),
    ):
        with pytest.raises(KeyError, match=r"did you mean 'left'.*left, right"):
            call()


def test_a_reset_forgets_contacts_places_and_stamps():
    tracker = tracker_of("left", "right")
    tracker.step(START, {"left": update("left")})
    tracker.reset("test")
    assert tracker.resets["test"] == 1
    again = tracker.step(START - 100 * STEP, {"right": update("right")})
    np.testing.assert_allclose(again.belief.pose.mean, OBJECT @ FEATURES["right"], atol=1e-13)


def test_another_place_starts_anew_in_its_frame():
    tracker = tracker_of("left", "right")
    tracker.step(START, {n: update(n) for n in ("left", "right")})
    tracker.set_place("right", GIVEN["right"])
    found = tracker.step(START + STEP, {n: update(n) for n in ("left", "right")})
    np.testing.assert_allclose(found.belief.pose.mean, OBJECT, atol=1e-13)
    assert found.unplaced == ("left",)


def test_other_settings_hold_from_the_next_step_and_contacts_stay():
    tracker = tracker_of("left", places=given("left"))
    tracker.step(START, {"left": update("left")})
    tracker.configure(TrackerSettings(max_age=0.01))
    assert tracker.step(START + STEP, {}).stale


def test_settings_that_contradict_each_other_are_refused():
    with pytest.raises(SettingError, match=r"max_age = 1 s: must not be longer than forget_after = 0\.5 s"):
        TrackerSettings(max_age=1.0)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_whatever_the_contacts_say_the_object_is_somewhere_finite_or_not_known(share):
    rng, known = np.random.default_rng(8), 0
    for _ in range(100):
        tracker = tracker_of("left", "right", correlated_share=share)
        for k in range(6):
            updates = {name: update(name) for name in ("left", "right")}
            for name in updates:
                if rng.random() < 0.5:
                    belief = PoseGaussian(extreme_mean(rng), extreme_covariance(rng))
                    updates[name] = ContactUpdate(belief, extreme_mean(rng))
            found = tracker.step(START + k * 10_000_000, updates)
            if found is not None and found.belief.pose is not None:
                known += 1
                assert np.isfinite(found.belief.pose.mean).all() and np.isfinite(found.belief.pose.cov).all()
    assert known > 100
