import dataclasses
import gzip
import hashlib

import jaxtyping
import numpy as np
import pytest

from jaxpanda.errors import InputError, MissingExtraError
from jaxpanda.recordings import Recording, distinct, load, load_many, save
from jaxpanda.recordings.checks import checked
from jaxpanda.recordings.ticks import consistent, reconstruct


def motion(time: np.ndarray, dof: int = 3) -> np.ndarray:
    """Joint positions that never rest all at once."""
    joints = np.arange(1, dof + 1)
    return 0.5 * np.sin(time[:, None] * (0.7 + 0.3 * joints) + joints)


def velocity(time: np.ndarray, dof: int = 3) -> np.ndarray:
    joints = np.arange(1, dof + 1)
    return 0.5 * (0.7 + 0.3 * joints) * np.cos(time[:, None] * (0.7 + 0.3 * joints) + joints)


def recording(samples: int = 200, dof: int = 3, rate: float = 100.0) -> Recording:
    time = np.arange(samples) / rate
    noise = np.random.default_rng(0).normal(size=(2, samples, dof))
    tau = 3 * motion(time, dof) + 0.1 * noise[0]
    return Recording("made", time, motion(time, dof), velocity(time, dof) + 1e-3 * noise[1], tau)


def rows(samples: int = 100, dof: int = 2) -> list[list[str]]:
    """Cells of a canonical CSV, header first."""
    made = recording(samples, dof)
    names = ["time", *(f"{c}_{j + 1}" for c in ("q", "dq", "tau") for j in range(dof))]
    table = np.column_stack([made.time, *made.channels()])
    return [names, *([repr(x) for x in row] for row in table.tolist())]


def text(cells: list[list[str]]) -> str:
    return "\n".join(",".join(row) for row in cells) + "\n"


def same(a: Recording, b: Recording) -> bool:
    pairs = zip([a.time, *a.channels()], [b.time, *b.channels()], strict=True)
    return all(np.array_equal(x, y) for x, y in pairs)


def test_positions_in_each_other_s_place_are_told_by_their_velocities():
    """Swapped columns of q had been taken for another mounting, at 0.99."""
    right = recording()
    swapped = dataclasses.replace(right, q=right.q[:, [0, 2, 1]])
    with pytest.raises(InputError, match=r"dq_2 is d\(q_3\)/dt, dq_3 is d\(q_2\)/dt: .*--columns"):
        checked(swapped)
    together = np.tile(motion(right.time)[:, :1], 3)  # all joints move alike: nothing tells them apart
    alike = dataclasses.replace(right, q=together, qd=np.tile(velocity(right.time)[:, :1], 3))
    assert checked(alike).samples == right.samples
    assert checked(dataclasses.replace(right, qd=-right.qd)).samples == right.samples


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".npz", ".parquet"])
@pytest.mark.parametrize("channels", ["all", "both torques", "no dq", "motion"])
def test_a_saved_recording_reads_back_to_the_same_numbers(tmp_path, suffix, channels):
    made = recording()
    made = Recording(
        "made",
        made.time,
        made.q,
        None if channels in ("no dq", "motion") else made.qd,
        None if channels == "motion" else made.tau,
        tau_motor=1.1 * made.tau if channels == "both torques" else None,
    )
    save(made, tmp_path / f"rec{suffix}")
    back = load(tmp_path / f"rec{suffix}")
    assert same(made, back)
    assert back.name == f"rec{suffix}"
    assert (back.qd is None, back.tau is None) == (made.qd is None, made.tau is None)
    assert not back.repairs
    assert [file.name for file in tmp_path.iterdir()] == [f"rec{suffix}"]


def test_saving_twice_writes_the_same_bytes(tmp_path):
    digests = set()
    for i in range(2):
        save(recording(), tmp_path / f"{i}.csv.gz")
        digests.add(hashlib.sha256((tmp_path / f"{i}.csv.gz").read_bytes()).hexdigest())
    assert len(digests) == 1


def test_saving_replaces_whole_or_not_at_all(tmp_path):
    with pytest.raises(InputError, match=r"no such|does not exist"):
        save(recording(), tmp_path / "nowhere" / "rec.csv")
    with pytest.raises(InputError, match="are written as"):
        save(recording(), tmp_path / "rec.mat")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "disguise",
    [
        lambda t: "\ufeff" + t,
        lambda t: t.replace("\n", "\r\n"),
        lambda t: t.replace(",", " , "),
        lambda t: t.replace(",", ";"),
        lambda t: t.replace(",", "\t"),
        lambda t: t + "\n\n",
        lambda t: t.replace("time", "TIME").replace("tau_", "Tau_"),
        lambda t: t.replace("q_1,", '"q_1",', 1),
        lambda t: "# logged on Monday\n# 250 Hz, cell 3\n" + t,
        lambda t: "# logged on Monday\n# " + t,
    ],
    ids=[
        *("byte-order mark", "CRLF", "spaces", "semicolons", "tabs", "blank lines", "capitals", "quotes"),
        *("comments", "comments, the last with the names"),
    ],
)
def test_a_csv_reads_the_same_however_it_is_dressed(tmp_path, disguise):
    (tmp_path / "plain.csv").write_text(text(rows()))
    (tmp_path / "dressed.csv").write_bytes(disguise(text(rows())).encode())
    assert same(load(tmp_path / "plain.csv"), load(tmp_path / "dressed.csv"))


def test_columns_may_come_in_any_order_and_others_are_named_and_ignored(tmp_path):
    cells = [[*reversed(row), "7.5"] for row in rows()]
    cells[0][-1] = "temperature"
    (tmp_path / "plain.csv").write_text(text(rows()))
    (tmp_path / "mixed.csv").write_text(text(cells))
    mixed = load(tmp_path / "mixed.csv")
    assert same(load(tmp_path / "plain.csv"), mixed)
    assert "temperature" in mixed.notes[0]


def test_other_names_are_mapped(tmp_path):
    cells = rows()
    (tmp_path / "plain.csv").write_text(text(cells))
    cells[0][0], cells[0][1] = "stamp", "shoulder"
    (tmp_path / "named.csv").write_text(text(cells))
    named = load(tmp_path / "named.csv", columns={"time": "stamp", "q_1": "shoulder"})
    assert same(load(tmp_path / "plain.csv"), named)
    with pytest.raises(InputError, match=r"named\.csv: no column 'elbow'"):
        load(tmp_path / "named.csv", columns={"time": "stamp", "q_1": "elbow"})


def _cell(row: int, column: int, value: str):
    def change(cells: list[list[str]]) -> str:
        cells[row][column] = value
        return text(cells)

    return change


def _scaled(columns: slice, factor: float):
    def change(cells: list[list[str]]) -> str:
        for row in cells[1:]:
            row[columns] = [repr(float(x) * factor) for x in row[columns]]
        return text(cells)

    return change


def _wrapped(cells: list[list[str]]) -> str:
    for row in cells[1:]:
        row[1] = repr((float(row[1]) + 2.68 + np.pi) % (2 * np.pi) - np.pi)
    return text(cells)


def _sliding(cells: list[list[str]]) -> str:
    """At 630 mm/s."""
    for row in cells[1:]:
        row[1] = repr(630 * float(row[0]))
    return text(cells)


def _reset(cells: list[list[str]]) -> str:
    for row in cells[50:]:
        row[2] = repr(float(row[2]) + 0.3)
    return text(cells)


BAD = {
    "not a number": (_cell(7, 2, "nan"), r"column q_2, row 7 \(line 8\): the value is nan"),
    "infinite": (_cell(9, 5, "inf"), r"column tau_1, row 9 \(line 10\): the value is inf"),
    "a word": (_cell(4, 3, "n/a"), r"column dq_1, row 4 \(line 5\): 'n/a' is no number"),
    "an empty cell": (_cell(4, 6, ""), r"column tau_2, row 4 \(line 5\): the cell is empty"),
    "a decimal comma": (lambda c: text(c).replace("0.01,", "0,01,", 1), r"row 2 \(line 3\) has 8 cells"),
    "a short row": (lambda c: text([*c[:5], c[5][:3], *c[6:]]), r"row 5 \(line 6\) has 3 cells"),
    "a cut last row": (lambda c: text(c)[:-30], r"row 100 \(line 101\)"),
    "a comma at the end of every line": (lambda c: text([[*r, ""] for r in c]), "every line ends with ','"),
    "a comma at the end of a line": (
        lambda c: text([*c[:4], [*c[4], ""], *c[5:]]),
        r"row 4 \(line 5\) ends with ','",
    ),
    "a missing column": (lambda c: text([r[:2] + r[3:] for r in c]), r"dq_1 \.\.\. dq_2.*or leave all dq"),
    "a hole among columns": (lambda c: text([r[:1] + r[2:] for r in c]), "column q_1 is missing"),
    "no time": (lambda c: text([r[1:] for r in c]), "no column time"),
    "no positions": (lambda c: text([[r[0], *r[3:]] for r in c]), "no columns q_1"),
    "joints from zero": (lambda c: text(c).replace("q_1", "q_0", 1), "q_0 cannot be|q_1 is missing"),
    "a column twice": (_cell(0, 2, "q_1"), "column q_1 is there twice"),
    "no header": (lambda c: text(c[1:]), "holds numbers where the header must be"),
    "a header alone": (lambda c: text(c[:1]), "a header but no rows"),
    "an empty file": (lambda c: "", "the file is empty"),
    "blank lines": (lambda c: "\n \n", "the file is empty"),
    "one row": (lambda c: text(c[:2]), "too short, 1 row over 0 s"),
    "too short": (lambda c: text(c[:12]), "too short, 11 rows"),
    "time repeated": (_cell(30, 0, "0.28"), r"column time, row 30 \(line 31\): time repeats"),
    "time going back": (_cell(30, 0, "0.1"), r"column time, row 30 \(line 31\): time goes back"),
    "degrees": (_scaled(slice(1, 5), 180 / np.pi), "looks like degrees"),
    "a wrapped angle": (
        _wrapped,
        r"column q_1, row \d+ \(line \d+\): the angle jumps by a turn.*numpy.unwrap",
    ),
    "a slide in millimetres": (
        _sliding,
        r"column q_1, row \d+ \(line \d+\): the angle jumps by a turn.*millimetres.*q_1=q_1:mm",
    ),
    "an encoder that was reset": (
        _reset,
        r"column q_2 jumps from \S+ rad to \S+ rad at 0.49 s and stays there.*--to, --from",
    ),
    "degrees per second": (_scaled(slice(3, 5), 180 / np.pi), "dq looks like degrees per second"),
    "no torque of a joint": (
        _scaled(slice(5, 7), 1e200),
        r"column tau_\d reaches .*e\+\d+ at .* no joint bears",
    ),
    "milliseconds": (_scaled(slice(0, 1), 1e3), "looks like milliseconds.*divide it by 1000"),
    "microseconds": (_scaled(slice(0, 1), 1e6), "looks like microseconds"),
    "10 Hz": (_scaled(slice(0, 1), 10), "10 Hz.*50 Hz to 4000 Hz"),
    "10 kHz": (_scaled(slice(0, 1), 0.01), "10000 Hz.*50 Hz to 4000 Hz"),
    "JSON": (lambda c: '{"time": [0, 1]}', "JSON or markup"),
    "prose": (lambda c: "Dear colleague,\nhere are the files.\n", "no column time"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_csv_is_refused_in_one_sentence_that_names_the_place(tmp_path, name):
    change, message = BAD[name]
    (tmp_path / "bad.csv").write_text(change(rows()))
    with pytest.raises(InputError, match=message) as raised:
        load(tmp_path / "bad.csv")
    assert str(raised.value).startswith("bad.csv: ")
    assert "\n" not in str(raised.value)


def _turning(factor: float, others: float) -> Recording:
    """A joint that turns on at 2.2 rad/s beside two that swing by half a radian, in a unit of that many."""
    made = recording(samples=1500)
    q = made.q * others
    q[:, 2] += 2.2 * made.time
    return Recording("made", made.time, factor * q, None, made.tau)


def test_a_joint_that_turns_on_and_on_is_no_degrees(tmp_path):
    """Went wrong: 33 rad of a continuous joint were refused as degrees."""
    save(_turning(1.0, 1.0), tmp_path / "on.csv")
    assert np.ptp(load(tmp_path / "on.csv").q[:, 2]) > 30


@pytest.mark.parametrize("recording", [_turning(180 / np.pi, 1.0), _turning(1.0, 0.1), _turning(1.0, 40.0)])
def test_a_joint_that_goes_as_far_beside_others_that_are_still_or_far_too_is_degrees(tmp_path, recording):
    save(recording, tmp_path / "degrees.csv")
    with pytest.raises(InputError, match=r"looks like degrees.*take whole turns off it"):
        load(tmp_path / "degrees.csv")


def test_a_gap_in_which_a_joint_turns_on_is_no_jump(tmp_path):
    made = _turning(1.0, 1.0)
    keep = (made.time < 5) | (made.time > 5 + 2 * np.pi / 2.2)
    cut = Recording("cut", made.time[keep], made.q[keep], None, None)
    save(cut, tmp_path / "cut.csv")
    assert same(load(tmp_path / "cut.csv"), cut)


def test_a_position_that_is_written_late_does_not_jump(tmp_path):
    made = recording(samples=1000, rate=1000.0)
    q = 20 * made.q
    q[400:420] = q[400]
    assert np.abs(np.diff(q, axis=0)).max() > 0.1
    late = Recording("late", made.time, q, None, made.tau)
    save(late, tmp_path / "late.csv")
    assert same(load(tmp_path / "late.csv"), late)


def test_line_numbers_count_blank_lines(tmp_path):
    cells = rows()
    cells[7][2] = "nan"
    (tmp_path / "bad.csv").write_text(text(cells[:3]) + "\n\n" + text(cells[3:]))
    with pytest.raises(InputError, match=r"row 7 \(line 10\)"):
        load(tmp_path / "bad.csv")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("bytes.csv", bytes(range(256)) * 20, "no text"),
        ("zeros.csv", bytes(1000), "binary data"),
        ("utf16.csv", text(rows()).encode("utf-16"), "no text|binary data"),
        ("cut.csv.gz", gzip.compress(text(rows()).encode())[:-40], "broken or truncated gzip"),
        ("plain.csv.gz", text(rows()).encode(), "broken or truncated gzip"),
        ("bytes.npz", bytes(range(256)) * 20, "no NumPy archive|no plain arrays"),
        ("bytes.parquet", bytes(range(256)) * 20, "no Parquet file"),
        ("empty.npz", b"", "no NumPy archive"),
        ("empty.parquet", b"", "no Parquet file"),
        ("log.xlsx", b"PK", "unknown kind of recording"),
    ],
)
def test_garbage_is_refused_whatever_it_calls_itself(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as raised:
        load(tmp_path / name)
    assert name in str(raised.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.csv: no such file"):
        load(tmp_path / "nowhere.csv")
    for format in ("csv", "npz", "parquet", "raw_logs"):
        with pytest.raises(InputError, match="no such"):
            load(tmp_path / "nowhere", format=format)
    with pytest.raises(InputError, match="unknown format 'ods'"):
        load(tmp_path / "nowhere", format="ods")


def _npz(tmp_path, **arrays):
    np.savez(tmp_path / "bad.npz", **arrays)
    return tmp_path / "bad.npz"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q": None}, "no array q"),
        ({"time": None}, "no array time"),
        ({"time": np.zeros((200, 1))}, r"array time has the shape \(200, 1\)"),
        ({"q": np.zeros(200)}, r"array q has the shape \(200,\)"),
        ({"tau": np.zeros((200, 2))}, r"array tau has the shape \(200, 2\)"),
        ({"dq": np.zeros((199, 3))}, r"array dq has the shape \(199, 3\)"),
        ({"qd": np.zeros((200, 3))}, "arrays dq and qd are both there"),
        ({"q": np.full((200, 3), None)}, "no plain arrays"),
        ({"time": np.zeros(0)} | dict.fromkeys(("q", "dq", "tau"), np.zeros((0, 3))), "too short, 0 rows"),
        ({"q": np.full((200, 3), "1")}, "where real numbers are needed"),
        (
            {"tau": np.r_[np.full((199, 3), np.nan), np.zeros((1, 3))]},
            "column tau_1, row 1: the value is nan and 198",
        ),
        (
            {"tau": np.tile([0, np.nan, 0], (200, 1))},
            "column tau_2: no row has a number, .* none: --columns tau= ",
        ),
        (
            {"q": np.full((200, 3), np.nan)},
            "column q_1: no row has a number, where every joint's are needed$",
        ),
    ],
)
def test_archives_with_wrong_arrays_are_refused(tmp_path, change, message):
    made = recording()
    arrays = {"time": made.time, "q": made.q, "dq": made.qd, "tau": made.tau} | change
    with pytest.raises(InputError, match=message):
        load(_npz(tmp_path, **{name: array for name, array in arrays.items() if array is not None}))


def test_parquet_says_which_column_holds_no_numbers(tmp_path):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    made = recording()
    table = {"time": made.time, "q_1": made.q[:, 0], "q_2": ["a"] * made.samples}
    parquet.write_table(arrow.table(table), tmp_path / "bad.parquet")
    with pytest.raises(InputError, match=r"bad\.parquet: column q_2 holds string"):
        load(tmp_path / "bad.parquet")


def test_parquet_without_pyarrow_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"jaxpanda\[io\]"):
        save(recording(), tmp_path / "rec.parquet")
    assert not list(tmp_path.iterdir())


def test_a_recording_of_another_arm_is_refused():
    made = recording(dof=3)
    made.require_dof(3)
    with pytest.raises(InputError, match=r"3 joints .* where the model has 7"):
        made.require_dof(7)


def test_a_motion_has_no_torque_to_identify_from():
    made = recording()
    with pytest.raises(InputError, match="not a motion"):
        Recording("motion", made.time, made.q).require_tau()


@pytest.mark.parametrize(
    ("column", "rows", "value"), [("tau_2", [120], 1e6), ("q_1", [0], 30.0), ("tau_3", [50, 51, 799], -4e3)]
)
def test_readings_that_stand_alone_are_left_out_and_told(tmp_path, column, rows, value):
    clean, path = recording(800), tmp_path / "glitch.csv"
    cells = [line.split(",") for line in _saved(clean, tmp_path).splitlines()]
    for row in rows:
        cells[row + 1][cells[0].index(column)] = repr(value)
    path.write_text(text(cells))
    read = load(path)
    kept = np.setdiff1d(np.arange(clean.samples), rows)
    assert np.array_equal(read.tau, clean.tau[kept])
    assert np.array_equal(read.q, clean.q[kept])
    assert list(read.repairs.values()) == [len(rows)]
    assert f"column {column} reads {value:g} at {clean.time[rows[0]]:g} s" in read.notes[0]


@pytest.mark.parametrize("shape", ["an impact", "a switch of sign", "an encoder's last digit", "tails"])
def test_what_an_arm_may_do_is_no_reading_that_stands_alone(tmp_path, shape):
    made, rng = recording(2000, rate=1000.0), np.random.default_rng(1)
    if shape == "an impact":  # 4 ms long, 40 N m
        made.tau[700:704, 0] += 40 * np.sin(np.pi * np.arange(1, 5) / 5)
    elif shape == "a switch of sign":
        made.tau[:, 0] = np.sign(made.tau[:, 0])
        made.tau[np.flatnonzero(np.diff(made.tau[:, 0]))[0] + 2, 0] *= -1
    elif shape == "an encoder's last digit":
        made.q[:, 1] = 0.7 + 1e-5 * (rng.random(2000) < 0.002)
        made.q[:, 2] = 0.1 + 1e-6 * rng.normal(size=2000)
        made.q[-1, 2] += 1e-3  # as the iiwa's sixth joint at the end of a log
    else:
        made.tau[:] += 0.1 * rng.standard_t(2.5, size=made.tau.shape)
    _saved(made, tmp_path)
    read = load(tmp_path / "made.csv")
    assert not read.repairs
    assert read.samples == made.samples


def _saved(made: Recording, folder) -> str:
    save(made, folder / "made.csv")
    return (folder / "made.csv").read_text()


def host_log(folder, flat: bool, **extra: str):
    """What a host writes that reads a 1 kHz controller too often here, too late there; returns true ticks."""
    key = np.random.default_rng(3)
    steps = key.choice([0, 1, 2, 3], p=[0.06, 0.86, 0.07, 0.01], size=4000)
    tick = np.concatenate([[0], np.cumsum(steps)])
    t = 1e-3 * tick
    stamps = t[-1] * np.linspace(0, 1, len(t)) + np.abs(key.normal(scale=2e-4, size=len(t)))
    stamps = np.maximum.accumulate(stamps) + 1e-7 * np.arange(len(t))
    late = velocity(t - 3e-3)
    tau = (3 * motion(t) + 0.1 * key.normal(size=(tick[-1] + 1, 3))[tick]).round(4)
    for name, x in {"joint_positions": motion(t).round(6), "velocity": late.round(5), "torques": tau}.items():
        np.savetxt(folder / f"log_{name}.txt", x.reshape(-1, 1) if flat else x, fmt="%.7g")
    np.savetxt(folder / "log_time.txt", stamps, fmt="%.7f")
    for name, content in extra.items():
        (folder / f"{name}.txt").write_text(content)
    return tick


@pytest.mark.parametrize("flat", [True, False], ids=["one number a line", "one sample a line"])
def test_ticks_of_a_host_stamped_log_are_found_again(tmp_path, flat):
    tick = host_log(tmp_path, flat, gen_dq="1\n2\n", gen_time="0\n1\n", readme="no log")
    rec = load(tmp_path)
    true = np.unique(tick)
    assert np.array_equal(np.round(rec.time * 1000).astype(int), true)
    assert rec.repairs["repeated rows dropped"] == len(tick) - len(true)
    assert rec.repairs["ticks missing between rows"] == tick[-1] + 1 - len(true)
    assert "rms(dq - d(q)/dt)" in rec.notes[0]
    assert np.max(np.abs(rec.q - motion(rec.time))) < 1e-6


def test_stamps_that_are_ticks_already_are_left_alone(tmp_path):
    time = np.delete(np.arange(3000) * 1e-3, [100, 101, 500])
    assert consistent(time)
    np.savetxt(tmp_path / "t_time.txt", time)
    np.savetxt(tmp_path / "t_position_measured.txt", motion(time))
    np.savetxt(tmp_path / "t_velocity_measured.txt", velocity(time))
    rec = load(tmp_path)
    assert np.allclose(rec.time, time, rtol=0, atol=1e-12)
    assert not rec.repairs
    assert not rec.notes


def test_ticks_of_an_arm_at_rest_cannot_be_told():
    time = np.arange(500) * 1e-3
    assert reconstruct(time, np.ones((500, 2)), np.zeros((500, 2))) is None


def test_a_rest_inside_a_motion_lasts_as_long_as_its_stamps_say():
    moving = np.arange(1000) * 1e-3
    clock = np.concatenate([moving, 1 + moving * 2, 3 + moving])
    q = np.concatenate([motion(moving), np.repeat(motion(np.array([1.0])), 1000, 0), motion(1 + moving)])
    qd = np.concatenate([velocity(moving), np.zeros((1000, 3)), velocity(1 + moving)])
    found = reconstruct(clock, q, qd, np.random.default_rng(0).normal(size=q.shape))
    assert found is not None
    assert abs(found.tick[2500] * found.period - clock[2500]) < 5e-3


def test_a_folder_with_several_runs_is_split_where_time_goes_back(tmp_path):
    time = np.arange(1000) * 1e-3
    np.savetxt(tmp_path / "time.txt", np.concatenate([time, time[:600]]))
    np.savetxt(tmp_path / "position.txt", np.concatenate([motion(time), motion(time[:600])]))
    runs = load_many([tmp_path])
    assert [run.samples for run in runs] == [1000, 600]
    assert len({run.name for run in runs}) == 2
    with pytest.raises(InputError, match=r"2 runs \(1000 rows, 600 rows\)"):
        load(tmp_path)


def test_recordings_of_one_name_are_called_by_their_folders(tmp_path):
    """Of two files `run.csv` both were called that, and what was found in one was looked up in the other."""
    made = Recording("made", np.arange(500) * 1e-2, motion(np.arange(500) * 1e-2))
    paths = [tmp_path / name for name in ("a/x/run.csv", "b/x/run.csv", "b/y/run.csv", "b/x/other.csv")]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        save(made, path)
    named = distinct(load_many(paths))
    assert [r.name for r in named] == ["a/x/run.csv", "b/x/run.csv", "y/run.csv", "other.csv"]
    assert [r.name for r in distinct(named)] == [r.name for r in named]
    with pytest.raises(InputError, match=r"b/x/run\.csv: is given twice"):
        distinct(load_many([*paths, tmp_path / "a" / ".." / "b" / "x" / "run.csv"]))
    with pytest.raises(InputError, match="made: is given twice, where each recording counts once"):
        distinct([made, made])


def test_files_of_one_log_are_cut_to_the_shortest_and_counted(tmp_path):
    time = np.arange(1000) * 1e-3
    np.savetxt(tmp_path / "time.txt", time)
    np.savetxt(tmp_path / "position.txt", motion(time)[:998])
    rec = load(tmp_path)
    assert rec.samples == 998
    assert rec.repairs == {"rows cut to the shortest file": 2}


def _write(folder, files: dict[str, np.ndarray]):
    for name, x in files.items():
        np.savetxt(folder / name, x)


T = np.arange(1000) * 1e-3


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "a folder without time stamps"),
        ({"time.txt": T}, "a folder without joint positions"),
        ({"gen_time.txt": T, "positions.txt": motion(T)}, "a folder without time stamps"),
        ({"a.csv": T, "b.csv": T}, r"a folder of other files \(a.csv and 1 more\), each a recording"),
        (
            {"a_time.txt": T, "b_time.txt": T, "positions.txt": motion(T)},
            "a_time.txt, b_time.txt could each be time",
        ),
        ({"time.txt": T, "positions.txt": motion(T)[:500]}, "500 rows, but time.txt has 1000"),
        ({"time.txt": T, "positions.txt": motion(T).ravel()[:-1]}, "cannot be shared among the 1000 rows"),
        ({"time.txt": motion(T), "positions.txt": motion(T)}, "3 numbers a line, where time has one"),
        (
            {"time.txt": T, "positions.txt": motion(T), "torques.txt": motion(T, 2)},
            "2 joints, but positions.txt has 3",
        ),
        ({"time.txt": T, "positions.txt": np.where(T == 0.5, np.nan, T)}, "positions.txt: column q, row 501"),
        (
            {"time.txt": np.where(T == 0.5, 0.499, T), "positions.txt": motion(T)},
            "column time, row 501: time repeats",
        ),
    ],
)
def test_folders_that_are_no_log_are_refused(tmp_path, files, message):
    _write(tmp_path, files)
    with pytest.raises(InputError, match=message):
        load(tmp_path)


def test_a_folder_s_files_can_be_named(tmp_path):
    _write(tmp_path, {"a_time.txt": T, "b_time.txt": 2 * T, "positions.txt": motion(T)})
    rec = load(tmp_path, columns={"time": "b_time.txt"})
    assert np.array_equal(rec.time, 2 * T)
    with pytest.raises(InputError, match=r"no file 'c_time\.txt'"):
        load(tmp_path, columns={"time": "c_time.txt"})


def test_the_log_of_gaz_et_al_has_the_ticks_that_the_notes_count(data):
    rec = load(data / "gaz_panda")
    assert rec.samples == 19291
    assert rec.repairs["repeated rows dropped"] == 1253
    assert rec.repairs["ticks missing between rows"] == 1688
    assert round(rec.time[-1] * 1000) + 1 == 20979
    slope = np.diff(rec.q, axis=0) / np.diff(rec.time)[:, None]
    assert rec.qd is not None
    assert np.sqrt(np.mean((slope - (rec.qd[1:] + rec.qd[:-1]) / 2) ** 2)) < 0.0115


def test_every_sweep_and_chirp_of_the_iiwa_reads(data):
    runs = load_many(sorted((data / "iiwa").iterdir()))
    assert len(runs) == 14  # one of the 13 folders holds two runs
    assert all(run.dof == 7 and run.qd is not None and run.tau is not None for run in runs)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"tau": np.ones((395, 2))}, r"tau has the shape \(395, 2\), where \(400, 2\) is needed"),
        ({"qd": np.ones((400, 3))}, "dq has the shape"),
        ({"q": np.ones(400)}, "q"),
        ({"time": np.zeros(400)}, "time repeats"),
        ({"tau": np.full((400, 2), np.inf)}, "column tau_1, row 1: the value is inf"),
        ({"tau": [["a"]]}, "no array of numbers"),
    ],
)
def test_a_recording_is_valid_by_construction(change, said):
    """Torque five rows short was "explained"."""
    whole = {"time": np.arange(400) / 100, "q": np.zeros((400, 2)), "qd": None, "tau": np.zeros((400, 2))}
    jaxtyping.config.update("jaxtyping_disable", True)  # as it is for users
    try:
        with pytest.raises(InputError, match=said):
            Recording("made.csv", **{**whole, **change})
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def test_units_are_looked_at_wherever_a_recording_came_from():
    from jaxpanda.signals import prepare

    made = recording(samples=1500)
    prepare(made)
    with pytest.raises(InputError, match="looks like degrees"):
        prepare(dataclasses.replace(made, q=np.rad2deg(made.q) * 8, qd=None))
    with pytest.raises(InputError, match="looks like milliseconds"):
        prepare(dataclasses.replace(made, time=1e3 * made.time))


def test_columns_that_a_user_names_make_no_log_of_libfranka(tmp_path):
    """`time`, beside q that was named, was taken for libfranka's, in milliseconds."""
    made = recording(samples=1500)
    path = tmp_path / "degrees.csv"
    save(dataclasses.replace(made, q=np.rad2deg(made.q), qd=None), path)
    read = load(path, columns={"q": "q_{j}:deg"})
    np.testing.assert_allclose(read.q, made.q, atol=1e-6)
    np.testing.assert_allclose(read.time, made.time, atol=1e-9)


@pytest.mark.parametrize(
    ("columns", "scale", "cure"),
    [
        ({"time": "stamp", "q": "pos{j}"}, {"time": 1e3}, "--columns time=stamp:ms"),
        (
            {"time": "stamp", "q": "pos{j}"},
            {"q": 8 * 180 / np.pi},
            "--columns q=pos{j}:deg, of one joint q_3=pos3:mm",
        ),
        ({}, {"time": 1e3}, "--columns time=time:ms"),
        ({}, {"q": 8 * 180 / np.pi}, "--columns q=q_{j}:deg, of one joint q_3=q_3:mm"),
    ],
)
def test_a_unit_is_to_be_said_of_the_columns_that_were_read(tmp_path, columns, scale, cure):
    made = recording(samples=1500)
    named = {c: getattr(made, c) * scale.get(c, 1.0) for c in ("time", "q")}
    prefix = {"time": columns.get("time", "time"), "q": columns.get("q", "q_{j}")}
    names = [prefix["time"], *(prefix["q"].replace("{j}", str(j + 1)) for j in range(made.dof))]
    path = tmp_path / "log.csv"
    np.savetxt(path, np.c_[named["time"], named["q"]], delimiter=",", header=",".join(names), comments="")
    with pytest.raises(InputError) as refused:
        load(path, columns=columns)
    assert cure in str(refused.value)


def test_columns_without_an_order_are_to_be_named_in_that_of_the_joints(tmp_path):
    path = tmp_path / "names.csv"
    path.write_text("t,lift_pos,elbow_pos\n" + "".join(f"{0.01 * k},0.1,0.2\n" for k in range(200)))
    with pytest.raises(InputError) as refused:
        load(path, columns={"time": "t", "q": "*_pos"})
    assert "'*_pos' (asked for as q) is lift_pos, elbow_pos" in str(refused.value)
    assert "as q=lift_pos,elbow_pos" in str(refused.value)
