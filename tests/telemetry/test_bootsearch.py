"""The search for boots, function by function: records at known positions and times, and limits from both sides."""

from math import inf

import numpy as np
import pytest

from glstar.arrays import Float, Integer
from glstar.telemetry import boots
from glstar.telemetry.boots import _Boot, _Piece, find_boots, running_median, within
from glstar.telemetry.source import EVERYWHERE, Boot

nan = np.nan
UTC_S = 1.7e9
NONE = np.empty(0, dtype=np.int64), np.empty(0), np.empty(0)


def steady(start_s: float, count: int, first: int = 0, step: int = 10, step_s: float = 0.1) -> tuple[Integer, Float]:
    """Return positions in a file, and times by the clock."""
    return first + step * np.arange(count), start_s + step_s * np.arange(count)


def joined(*parts: tuple[Integer, Float]) -> tuple[Integer, Float]:
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def utc(series: tuple[Integer, Float], offset_s: float | Float) -> tuple[Integer, Float, Float]:
    return series[0], series[1], series[1] + offset_s


def spans(pieces: list[_Piece]) -> list[tuple[int, int]]:
    return [piece.span for piece in pieces]


# --- small parts ----------------------------------------------------------------------------------------------------
def test_positions_are_within_half_open_ranges() -> None:
    position = np.array([2, 3, 4, 7, 8, 9])
    assert within(position, [(3, 4), (8, 9)]).tolist() == [0, 1, 0, 0, 1, 0]
    assert within(position, []).tolist() == [0] * 6


@pytest.mark.parametrize("count", [1, 4, 5, 6, 30])
def test_a_running_median_is_that_of_five(count: int) -> None:
    values = np.random.default_rng(count).uniform(3, 9, count)
    inner = [float(np.median(values[k - 2 : k + 3])) for k in range(2, count - 2)]
    expected = [inner[0]] * 2 + inner + [inner[-1]] * 2 if inner else [float(np.median(values))] * count
    assert running_median(values).tolist() == expected


def test_damaged_times_are_left_out() -> None:
    position, clock_s = steady(5.0, 9)
    clock_s[[2, 7]] = [nan, 900.0]
    clock_s[4] += 0.19  # less than the limit from the median of three
    left = boots._valid_series(position, clock_s, 0.1)
    assert left[0].tolist() == [0, 10, 30, 40, 50, 60, 80]
    clock_s[4] += 0.03
    assert boots._valid_series(position, clock_s, 0.1)[0].tolist() == [0, 10, 30, 50, 60, 80]
    finite = boots._finite_readings(np.arange(4), np.array([1.0, nan, 3.0, 4.0]), np.array([5.0, 6.0, nan, 8.0]))
    assert [column.tolist() for column in finite] == [[0, 3], [1.0, 4.0], [5.0, 8.0]]


def test_intervals_are_covered_by_the_fewest_positions() -> None:
    assert boots._covering([]) == []
    assert boots._covering([(3, 9)]) == [9]
    assert boots._covering([(3, 9), (4, 7), (6, 8)]) == [7]
    assert boots._covering([(3, 9), (4, 7), (7, 8)]) == [7, 8]
    assert boots._covering([(20, 30), (3, 9), (9, 25)]) == [9, 25]
    assert boots._covering([(20, 30), (3, 9), (8, 25), (25, 26)]) == [9, 26]


def test_a_step_back_is_one_of_most_kinds_of_records() -> None:
    back = joined(steady(50.0, 30), steady(2.0, 30, 300))
    on = steady(50.0, 60, 5)
    assert boots._backward([back], 0.1) == [(290, 300)]
    # Of two kinds with equally many records one suffices; of fewer records it does not.
    assert boots._backward([back, on], 0.1) == [(290, 300)]
    assert boots._backward([back, steady(50.0, 61, 5)], 0.1) == []
    assert boots._backward([back, on, steady(50.0, 3, 7)], 0.1) == [(290, 300)]  # it does not span the step
    other = joined(steady(50.0, 30, 3), steady(2.0, 30, 303))
    assert boots._backward([back, other, on], 0.1) == [(290, 300), (293, 303)]
    later = joined(steady(50.0, 40, 3), steady(2.0, 20, 403))
    assert boots._backward([back, later, on], 0.1) == []  # at another place
    assert boots._backward([], 0.1) == []


@pytest.mark.parametrize(("back_s", "is_step"), [(0.096, False), (0.104, True)])
def test_a_step_back_is_larger_than_a_tenth_of_a_second(back_s: float, is_step: bool) -> None:
    clock_s = np.array([5.0, 6.0, 6.0 - back_s, 7.0])
    assert boots._backward([(np.array([1, 4, 9, 16]), clock_s)], 0.1) == ([(4, 9)] if is_step else [])


@pytest.mark.parametrize(("forward_s", "is_step"), [(4.8, False), (5.2, True)])
def test_a_step_forward_is_of_all_records_together(forward_s: float, is_step: bool) -> None:
    one = np.array([1, 4, 9, 16]), np.array([5.0, 6.0, 6.0 + forward_s, 7.0 + forward_s])
    assert boots._forward([one]) == ([(4, 9)] if is_step else [])
    assert boots._forward([one, (np.array([6]), np.array([8.0]))]) == []
    assert boots._forward([one, (np.array([6]), np.array([5.5]))]) == ([(6, 9)] if is_step else [])
    # A record that is late is no step, nor is the next one after it.
    late = np.array([1, 4, 9, 16]), np.array([50.0, 60.0, 6.0, 61.0])
    assert boots._forward([late]) == [(1, 4)]
    assert boots._forward([]) == boots._forward([(np.empty(0, dtype=np.int64), np.empty(0))]) == []
    assert boots._forward([(np.array([3]), np.array([5.0]))]) == []


def test_pieces_are_between_heads_and_jumps_of_the_clock() -> None:
    series = joined(steady(50.0, 30), steady(2.0, 30, 300), steady(90.0, 30, 600))
    found = boots._cut_at_clock([series], [0, 150, 890], 0.1)
    assert spans(found) == [(0, 150), (150, 300), (300, 600), (600, 890), (890, EVERYWHERE)]
    assert [piece.follows for piece in found] == ["start", "head", "back", "forward", "head"]
    assert [piece.inner for piece in found] == spans(found)
    assert spans(boots._cut_at_clock([steady(5.0, 30)], [], 0.1)) == [(0, EVERYWHERE)]


# --- steps of UTC ---------------------------------------------------------------------------------------------------
WHOLE = _Piece((0, EVERYWHERE), "start")


@pytest.mark.parametrize(("step_s", "is_cut"), [(0.48, False), (0.52, True), (-0.48, False), (-0.52, True)])
def test_a_piece_is_cut_where_utc_steps_against_the_clock(step_s: float, is_cut: bool) -> None:
    series = steady(5.0, 400)
    readings = utc((series[0][::5], series[1][::5]), np.where(np.arange(80) >= 40, UTC_S + step_s, UTC_S))
    found = boots._cut_at_steps(WHOLE, [series], readings)
    # Records between the readings at 1950 and 2000 are of neither.
    assert spans(found) == ([(0, 1951), (2000, EVERYWHERE)] if is_cut else [(0, EVERYWHERE)])
    if is_cut:
        assert (found[1].follows, found[1].unbroken, found[0].unbroken) == ("step", True, False)
    assert spans(boots._cut_at_steps(_Piece((0, 1990), "start"), [series], readings)) == [(0, 1990)]


def test_two_wrong_readings_are_no_step_and_a_wrong_one_beside_a_step_is_passed_over() -> None:
    series = steady(5.0, 400)
    position, clock_s = series[0][::5], series[1][::5]
    odd = np.full(80, UTC_S)
    odd[[30, 31]] += 40
    assert spans(boots._cut_at_steps(WHOLE, [series], (position, clock_s, clock_s + odd))) == [(0, EVERYWHERE)]
    both = np.where(np.arange(80) >= 40, UTC_S + 30, UTC_S)
    both[[39, 40]] = UTC_S + 77
    assert spans(boots._cut_at_steps(WHOLE, [series], (position, clock_s, clock_s + both))) == [
        (0, 1901),
        (2050, EVERYWHERE),
    ]
    assert spans(boots._cut_at_steps(WHOLE, [series], utc((position[:1], clock_s[:1]), UTC_S))) == [(0, EVERYWHERE)]
    assert spans(boots._cut_at_steps(WHOLE, [series], NONE)) == [(0, EVERYWHERE)]


@pytest.mark.parametrize(("wrong", "is_boot"), [(19, False), (22, True)])
def test_a_receiver_that_is_wrong_for_ten_seconds_is_no_boot(wrong: int, is_boot: bool) -> None:
    """Readings are at 0.5 s, and the records go on."""
    series = steady(5.0, 800)
    position, clock_s = series[0][::5], series[1][::5]
    offset_s = np.where((np.arange(160) >= 60) & (np.arange(160) < 60 + wrong), UTC_S + 30, UTC_S)
    found = boots._cut_at_steps(WHOLE, [series], (position, clock_s, clock_s + offset_s))
    last = 3000 + 50 * wrong
    assert spans(found) == ([(0, 2951), (3000, last - 49), (last, EVERYWHERE)] if is_boot else [(0, EVERYWHERE)])
    # Where the records do not go on, another boot begins; after it they do, for less than ten seconds.
    broken = np.concatenate([series[0][:300], series[0][310:]]), np.concatenate([series[1][:300], series[1][310:]])
    keep = (position < 2960) | (position > 3100)
    parts = boots._cut_at_steps(WHOLE, [broken], tuple(c[keep] for c in (position, clock_s, clock_s + offset_s)))
    assert spans(parts) == [(0, 2951), (3150, EVERYWHERE)]


def test_records_go_on_without_a_pause_of_three_intervals() -> None:
    series = steady(5.0, 100)
    assert boots._continues([series], 300, 320)
    assert boots._continues([steady(9.0, 3), series], 300, 320)  # of the kind with most records
    for pause_s, goes_on in ((0.29, True), (0.31, False)):
        paused = series[0], series[1] + np.where(np.arange(100) >= 31, pause_s - 0.1, 0.0)
        assert boots._continues([paused], 300, 310) is goes_on
    back = series[0], series[1] - np.where(np.arange(100) >= 31, 0.15, 0.0)
    assert not boots._continues([back], 300, 310)
    assert boots._continues([back], 400, 410)
    assert not boots._continues([], 300, 310)
    assert not boots._continues([steady(5.0, 2)], 0, 10)
    assert boots._continues([steady(5.0, 3)], 0, 10)
    assert not boots._continues([series], 2000, 2010)
    gone = series[0][series[0] != 310], series[1][series[0] != 310]
    assert boots._continues([gone], 305, 315)
    assert not boots._continues([(series[0][::1], series[1])], -50, -40)


# --- arrivals -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("step_s", "is_cut"), [(0.96, False), (1.04, True), (-1.04, True)])
def test_a_piece_is_cut_where_the_recorder_steps_against_the_clock(step_s: float, is_cut: bool) -> None:
    arrivals = utc(steady(5.0, 60), np.where(np.arange(60) >= 25, 700.0 + step_s, 700.0))
    piece = _Piece((0, 5000), "back")
    found = boots._cut_at_arrivals(piece, arrivals)
    assert spans(found) == ([(0, 250), (250, 5000)] if is_cut else [(0, 5000)])
    assert [one.follows for one in found] == (["back", "forward"] if is_cut else ["back"])
    assert boots._cut_at_arrivals(_Piece((0, 40), "back"), arrivals)[0].span == (0, 40)
    assert spans(boots._cut_at_arrivals(_Piece((230, 270), "back"), arrivals)) == [(230, 270)]
    assert spans(boots._cut_at_arrivals(_Piece((210, 290), "back"), arrivals)) == (
        [(210, 250), (250, 290)] if is_cut else [(210, 290)]
    )


def test_late_packets_are_no_step_of_the_recorder() -> None:
    late = np.full(60, 700.0)
    late[[20, 21]] += 8
    assert spans(boots._cut_at_arrivals(WHOLE, utc(steady(5.0, 60), late))) == [(0, EVERYWHERE)]
    two = np.where(np.arange(60) >= 40, 900.0, np.where(np.arange(60) >= 20, 800.0, 700.0))
    assert spans(boots._cut_at_arrivals(WHOLE, utc(steady(5.0, 60), two))) == [
        (0, 200),
        (200, 400),
        (400, EVERYWHERE),
    ]


# --- pieces and boots -----------------------------------------------------------------------------------------------
def piece(first_s: float, last_s: float, records: int = 9, **more: object) -> _Piece:
    fields = {"span": (0, 10), "follows": "start", "first_s": first_s, "last_s": last_s, "records": records}
    return _Piece(**fields | more)


def test_a_boot_has_the_utc_of_its_longest_piece() -> None:
    boot = _Boot([piece(5, 9, 4, utc_minus_clock_s=3.0), piece(9, 30, 7, utc_minus_clock_s=4.0), piece(30, 90, 50)])
    assert (boot.utc_minus_clock_s, boot.last_s, boot.records) == (4.0, 90, 61)
    assert boot.arrival_minus_clock_s is None
    boot.pieces.append(piece(1, 2, 1, arrival_minus_clock_s=6.0))
    assert (boot.arrival_minus_clock_s, boot.last_s) == (6.0, 90)
    assert _Boot([piece(5, 9)]).utc_minus_clock_s is None


@pytest.mark.parametrize(
    ("first_s", "last_s", "overlaps"),
    [(19.04, 40, False), (18.96, 40, True), (1, 11.04, True), (1, 10.96, False), (12, 13, True), (1, 40, True)],
)
def test_pieces_overlap_by_more_than_a_second(first_s: float, last_s: float, overlaps: bool) -> None:
    assert _Boot([piece(500, 600), piece(10, 20)]).overlaps(piece(first_s, last_s)) is overlaps


OLD = {"utc_minus_clock_s": 100.0}


@pytest.mark.parametrize(
    ("of", "boot", "strict", "is_of"),
    [
        (piece(20, 30, utc_minus_clock_s=100.48), piece(5, 9, **OLD), True, True),
        (piece(20, 30, utc_minus_clock_s=100.52), piece(5, 9, **OLD), True, False),
        (piece(20, 30, utc_minus_clock_s=99.48), piece(5, 9, **OLD), True, False),
        (piece(7, 30, utc_minus_clock_s=100.0), piece(5, 9, **OLD), True, False),  # they overlap
        (piece(900, 930, follows="head", utc_minus_clock_s=100.0), piece(5, 9, **OLD), True, True),
        (piece(20, 30, arrival_minus_clock_s=7.96), piece(5, 9, arrival_minus_clock_s=7.0), True, True),
        (piece(20, 30, arrival_minus_clock_s=8.04), piece(5, 9, arrival_minus_clock_s=7.0), True, False),
        (piece(20, 30, arrival_minus_clock_s=5.96), piece(5, 9, arrival_minus_clock_s=7.0), True, False),
        (piece(8.04, 30, arrival_minus_clock_s=7.0), piece(5, 9, arrival_minus_clock_s=7.0), True, True),
        (piece(7.96, 30, arrival_minus_clock_s=7.0), piece(5, 9, arrival_minus_clock_s=7.0), True, False),
        (piece(20, 30, follows="head", arrival_minus_clock_s=7.0), piece(5, 9, arrival_minus_clock_s=7.0), True, False),
        (piece(13.8, 30), piece(5, 9), True, True),
        (piece(14.2, 30), piece(5, 9), True, False),
        (piece(14.2, 30), piece(5, 9), False, True),
        (piece(14.2, 30, **OLD), piece(5, 9), False, True),
        (piece(7.96, 30), piece(5, 9), False, False),
        (piece(10.0, 30, follows="head"), piece(5, 9), False, False),
    ],
)
def test_a_piece_belongs_to_a_boot_by_utc_by_arrival_or_by_its_order(
    of: _Piece, boot: _Piece, strict: bool, is_of: bool
) -> None:
    of.after = boot
    assert boots._is_of(of, _Boot([boot]), strict) is is_of
    if of.utc_minus_clock_s is None and of.arrival_minus_clock_s is None:
        of.after = piece(1, 2)  # it follows another piece
        assert not boots._is_of(of, _Boot([boot]), strict)


def test_pieces_with_fewer_than_three_records_are_damaged() -> None:
    three = [piece(5, 9, 3), piece(9, 10, 2), piece(10, 20, 3)]
    found = boots._assigned(three, lambda one, boot: one.after is boot.pieces[-1])
    assert [[one.first_s for one in boot.pieces] for boot in found] == [[5, 10]]
    assert (three[0].after, three[2].after) == (None, three[0])
    found = boots._assigned(three, lambda *_: False)
    assert [[one.first_s for one in boot.pieces] for boot in found] == [[5], [10]]


def test_a_piece_is_measured_without_the_records_beside_a_cut() -> None:
    one, other = steady(5.0, 40), steady(3.0, 10, 105)
    of = _Piece((100, 200), "back")
    of.inner = (110, 190)
    readings = utc(one, np.where(np.arange(40) < 15, UTC_S, UTC_S + 4))
    boots._measure(of, [one, other], readings, utc(one, 700.0))
    assert (of.records, of.first_s, of.last_s) == (16, pytest.approx(3.1, abs=1e-9), pytest.approx(6.8, abs=1e-9))
    assert of.utc_minus_clock_s == UTC_S + 2
    assert of.arrival_minus_clock_s == pytest.approx(700.0, abs=1e-9)
    empty = _Piece((900, 999), "back")
    boots._measure(empty, [one], readings, None)
    assert (empty.records, empty.first_s, empty.last_s) == (0, inf, -inf)
    assert empty.utc_minus_clock_s is empty.arrival_minus_clock_s is None


def test_the_records_beside_a_cut_may_be_halves() -> None:
    pieces = [
        _Piece((0, 100), "start"),
        _Piece((100, 200), "back"),
        _Piece((200, 300), "step"),
        _Piece((300, 400), "forward"),
    ]
    boots._find_halves(pieces, [(np.array([70, 90, 100, 130]), np.zeros(4)), (np.array([85, 110, 290]), np.zeros(3))])
    assert [one.inner for one in pieces] == [(0, 90), (110, 200), (200, 290), (400, 400)]
    boots._leave_out_halves(pieces, [_Boot([pieces[0], pieces[2], pieces[3]]), _Boot([pieces[1]])])
    assert spans(pieces) == [(0, 90), (110, 200), (200, 300), (300, 400)]
    separate = [_Piece((0, 100), "start"), _Piece((100, 200), "forward"), _Piece((210, 300), "back")]
    for one in separate:
        one.inner = (one.span[0] + 5, one.span[1] - 5)
    boots._leave_out_halves(separate, [_Boot([one]) for one in separate])
    assert spans(separate) == [(0, 95), (105, 200), (210, 300)]


def test_the_utc_of_a_boot_beside_a_longer_one_is_in_doubt() -> None:
    """UTC steps while the records go on."""
    long = _Boot([piece(5, 9, 50, **OLD)])
    short = _Boot([piece(9.5, 30, 9, span=(20, 30), unbroken=True, utc_minus_clock_s=130.0)])
    first, second = boots._with_doubts([(Boot(1), long), (Boot(2), short)])
    assert first == Boot(1)
    assert second == Boot(2, doubt="UTC steps by 30.0 s between it and boot 1, but the clock goes on")
    equal = _Boot([piece(9.5, 30, 50, span=(20, 30), unbroken=True, utc_minus_clock_s=130.0)])
    first, second = boots._with_doubts([(Boot(1), long), (Boot(2), equal)])
    assert first.doubt == "UTC steps by 30.0 s between it and boot 2, but the clock goes on"
    assert second.doubt == ""
    for first_s, step_s in ((9.0, 30.0), (8.9, None), (13.9, 30.0), (14.1, None)):
        later = _Boot([piece(first_s, 40, span=(20, 30), unbroken=True, utc_minus_clock_s=130.0)])
        assert boots._unbroken_step_s(later, long) == boots._unbroken_step_s(long, later) == step_s
    broken = _Boot([piece(9.5, 30, span=(20, 30), utc_minus_clock_s=130.0)])
    unknown = _Boot([piece(9.5, 30, span=(20, 30), unbroken=True)])
    assert boots._unbroken_step_s(broken, long) is boots._unbroken_step_s(unknown, long) is None


# --- the whole search -----------------------------------------------------------------------------------------------
def test_a_single_boot_spans_everything() -> None:
    series = steady(5.0, 100)
    assert find_boots([series], NONE) == (Boot(1),)
    assert find_boots([series], utc(series, UTC_S), heads=[0]) == (Boot(1),)
    assert find_boots([], NONE) == (Boot(1),)
    paused = joined(steady(5.0, 50), steady(100.0, 50, 500))
    assert find_boots([paused], utc(paused, UTC_S)) == (Boot(1),)
    assert find_boots([paused], NONE) == (Boot(1),)  # its order says so


def test_two_boots_are_left_without_the_records_beside_the_cut() -> None:
    series = joined(steady(50.0, 50, step_s=0.09), steady(2.0, 50, 500, step_s=0.09))
    assert find_boots([series], NONE) == (Boot(1, ((0, 490),)), Boot(2, ((510, EVERYWHERE),)))
    assert find_boots([series], NONE, checked=True) == (Boot(1, ((0, 500),)), Boot(2, ((500, EVERYWHERE),)))
    small = joined(steady(50.0, 50), steady(54.9 - 4.8, 50, 500))
    assert find_boots([small], NONE, checked=True, back_s=5.0) == (Boot(1),)
    assert len(find_boots([small], NONE, checked=True)) == 2


def test_a_pause_without_utc_is_another_boot_if_the_log_knows_utc() -> None:
    paused = joined(steady(5.0, 50), steady(100.0, 50, 500))
    assert find_boots([paused], NONE, knows_utc=True, checked=True) == (
        Boot(1, ((0, 500),)),
        Boot(2, ((500, EVERYWHERE),)),
    )
    half = utc((paused[0][:50], paused[1][:50]), UTC_S)
    assert len(find_boots([paused], half)) == 2
    assert find_boots([paused], half, knows_utc=False) == (Boot(1),)


def test_boots_have_one_layout_and_files_one_head() -> None:
    paused = joined(steady(5.0, 50), steady(100.0, 50, 500))
    readings = utc(paused, UTC_S)
    asked: list[tuple[int, int]] = []

    def alike(one: int, other: int) -> bool:
        asked.append((one, other))
        return False

    assert len(find_boots([paused], readings, (), alike)) == 2
    assert asked == [(0, 500)]
    assert find_boots([paused], readings, [500]) == (Boot(1),)
    assert len(find_boots([paused], NONE, [500])) == 2


def test_arrivals_separate_boots_without_utc() -> None:
    series = joined(steady(5.0, 50), steady(10.5, 50, 500))
    arrivals = utc(series, np.where(np.arange(100) >= 50, 800.0, 700.0))
    assert find_boots([series], NONE, arrivals=arrivals, checked=True) == (
        Boot(1, ((0, 500),)),
        Boot(2, ((500, EVERYWHERE),)),
    )
    assert find_boots([series], NONE, arrivals=utc(series, 700.0), checked=True) == (Boot(1),)
    assert find_boots([series], NONE) == (Boot(1),)


def test_a_piece_of_two_records_is_of_no_boot() -> None:
    parts = steady(50.0, 50, step_s=0.09), steady(20.0, 2, 500, step_s=0.09), steady(2.0, 50, 520, step_s=0.09)
    found = find_boots([joined(*parts)], NONE, checked=True)
    assert [boot.spans for boot in found] == [((0, 500),), ((520, EVERYWHERE),)]
