"""Tables of text that controllers write: libfranka, panda-py, UR, KUKA; and what `--columns` says of others."""

import dataclasses

import numpy as np
import pytest
from made import assert_same, made

from jaxpanda.errors import InputError
from jaxpanda.recordings import Reading, Recording, load, save


def table(columns: dict[str, np.ndarray], separator: str = ",", comment: str = "") -> str:
    rows = [comment + separator.join(columns)]
    rows += [separator.join(map(repr, row)) for row in np.column_stack(list(columns.values())).tolist()]
    return "\n".join(rows) + "\n"


def numbered(pattern: str, channel: np.ndarray, first: int = 0) -> dict[str, np.ndarray]:
    return {pattern.format(j=j + first): channel[:, j] for j in range(channel.shape[1])}


def test_libfranka_s_log_is_in_milliseconds_and_its_tau_J_is_taken(tmp_path):
    """The header of `franka::logToCSV` (libfranka 0.9 to 0.15), older ones with blanks after commas."""
    r = made()
    columns = {"time": np.round(1000 * r.time), "success_rate": np.ones_like(r.time)}
    columns |= numbered("state.q[{j}]", r.q) | numbered("state.q_d[{j}]", r.q + 1)
    columns |= numbered("state.dq[{j}]", r.qd) | numbered("state.tau_J[{j}]", r.tau)
    columns |= numbered("state.tau_ext_hat_filtered[{j}]", 0 * r.tau) | numbered(
        "cmd.tau_J_d[{j}]", 0 * r.tau
    )
    for separator in (",", ", "):
        (tmp_path / "log.csv").write_text(table(columns, separator))
        read = load(tmp_path / "log.csv")
        assert_same(read, r)
        assert read.origin is not None
        assert read.origin.torque == "measured"
        assert read.origin.channels["tau"] == "state.tau_J[0] … state.tau_J[6]"
        assert "libfranka" in read.origin.source


def test_panda_py_s_log_is_in_milliseconds_as_table_and_as_arrays(tmp_path):
    r = made()
    columns = (
        {"time": 1000 * r.time}
        | numbered("q_{j}", r.q)
        | numbered("dq_{j}", r.qd)
        | numbered("tau_J_{j}", r.tau)
    )
    (tmp_path / "log.csv").write_text(table(columns))
    np.savez(
        tmp_path / "log.npz",
        time=1000 * r.time[:, None],
        q=r.q,
        dq=r.qd,
        tau_J=r.tau,
        O_T_EE=np.ones((200, 16)),
    )
    for name in ("log.csv", "log.npz"):
        read = load(tmp_path / name)
        assert_same(read, r)
        assert read.origin is not None
        assert "panda-py" in read.origin.source


def rtde(r: Recording) -> dict[str, np.ndarray]:
    columns = {"timestamp": r.time + 1017.78} | numbered("target_q_{j}", r.q + 1)
    columns |= numbered("target_moment_{j}", r.tau + 1) | numbered("actual_q_{j}", r.q)
    return columns | numbered("actual_qd_{j}", r.qd) | numbered("actual_current_{j}", 0.1 * r.tau)


def test_ur_s_rtde_holds_no_measured_torque_and_says_what_could_be_taken(tmp_path):
    """`target_moment` is commanded: taken for torque, a tool explains the controller's own model."""
    r = made(dof=6)
    for separator in (" ", ","):
        (tmp_path / "rtde.csv").write_text(table(rtde(r), separator))
        read = load(tmp_path / "rtde.csv")
        assert np.array_equal(read.q, r.q)
        assert np.array_equal(read.time, r.time + 1017.78)
        with pytest.raises(InputError, match=r"target_moment is commanded.*tau=actual_current_\{j\}"):
            read.require_tau()
        current = load(tmp_path / "rtde.csv", reading=Reading(("tau=actual_current_{j}",)))
        assert current.origin is not None
        assert (current.origin.torque, current.origin.says) == ("current", "the motors' current, no torque")
        assert np.array_equal(current.require_tau(), 0.1 * r.tau)


def test_kuka_s_recorder_keeps_seconds_and_nanoseconds_apart(tmp_path):
    r = made()
    ns = np.round(1e9 * r.time).astype(int)
    columns = {"ZeitInSec": 1_700_000_000 + ns // 10**9, "ZeitInNanoSec": ns % 10**9}
    columns |= numbered("axisQMsr_LBR_iiwa_7_R800_1[{j}]", r.q) | numbered(
        "axisTauMsr_LBR_iiwa_7_R800_1[{j}]", r.tau
    )
    (tmp_path / "fri.log").write_text(table(columns, " ", "% "))
    assert_same(load(tmp_path / "fri.log"), r, qd=False)


COLUMNS = ("time=t:ms", "q=joint_{j}_pos:deg", "dq=v1,v2,v3", "tau=e[0:3]")


def foreign(r: Recording) -> dict[str, np.ndarray]:
    columns = {"t": 1000 * r.time} | numbered("joint_{j}_pos", np.degrees(r.q), 1)
    return columns | numbered("v{j}", r.qd, 1) | numbered("e[{j}]", r.tau) | {"e[3]": r.time}


def test_columns_say_which_is_which_and_in_which_unit(tmp_path):
    r = made(dof=3)
    (tmp_path / "mine.csv").write_text(table(foreign(r)))
    assert_same(load(tmp_path / "mine.csv", reading=Reading(COLUMNS)), r, atol=1e-15)
    motion = load(tmp_path / "mine.csv", reading=Reading((*COLUMNS[:2], "tau=")))
    assert motion.tau is None
    assert motion.qd is None


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ((), r"no column time; it has the columns t, joint_\{j\}_pos, v\{j\}, e\[\{j\}\], where"),
        (("time=t:ms", "q=pos_{j}"), r"no column 'pos_\{j\}' \(asked for as q\); it has the columns t,"),
        (("time=t:deg", "q=v{j}"), "deg is no unit of time; its units are s, ms, us, ns"),
        (("time=t:ms", "q=v{j}", "tau=v1:deg"), "torque's is said by --torque-unit"),
        (("time=v{j}", "q=v{j}"), r"'v\{j\}' is 3 columns, where time is one"),
        (("time=t:ms", "q=v{j}", "tau=e[{j}]"), "3 columns q_1 ... q_3 but 4 columns tau_1 ... tau_4"),
        (("time=t", "q=v{j}"), "column time looks like milliseconds"),
        (("time=t:ms", "q="), "q cannot be left out"),
        (("pos=v{j}",), "CHANNEL is one of time, q, dq, tau"),
        (("q=v{j}", "q=e{j}"), "q is said twice"),
    ],
)
def test_columns_that_cannot_be_meant_are_refused(tmp_path, columns, message):
    (tmp_path / "mine.csv").write_text(table(foreign(made(dof=3))))
    with pytest.raises(InputError, match=message):
        load(tmp_path / "mine.csv", reading=Reading(columns))


def test_names_that_look_like_it_are_proposed_and_not_taken(tmp_path):
    r = made(dof=3)
    names = {"Time": r.time} | numbered("Position{j}", r.q, 1) | numbered("Torque{j}", r.tau, 1)
    names |= numbered("TorqueCmptd{j}", r.tau, 1)
    (tmp_path / "kinova.csv").write_text(table(names))
    proposed = "time=Time q=Position{j} tau=Torque{j}"
    with pytest.raises(InputError) as raised:
        load(tmp_path / "kinova.csv")
    assert str(raised.value).endswith(f"perhaps --columns {proposed}")
    assert_same(load(tmp_path / "kinova.csv", reading=Reading(tuple(proposed.split()))), r, qd=False)


def test_a_table_without_a_header_is_said_by_numbers(tmp_path):
    r = made(dof=3)
    text = table({"time": r.time} | numbered("q{j}", r.q) | numbered("t{j}", r.tau), " ").split("\n", 1)[1]
    (tmp_path / "bare.txt").write_text(text)
    with pytest.raises(InputError, match=r"line 1 holds numbers.*--columns time=1 q=2\.\.8"):
        load(tmp_path / "bare.txt")
    assert_same(load(tmp_path / "bare.txt", columns={"time": "1", "q": "2..4", "tau": "5..7"}), r, qd=False)


def test_from_and_to_cut_by_the_recording_s_time_and_before_it_is_checked(tmp_path):
    r = made(dof=3)
    q = r.q.copy()
    q[-1] = np.nan  # what is cut away is not looked at, and rows still count from the file's first
    columns = {"time": r.time + 5} | numbered("q_{j}", q, 1)
    (tmp_path / "rec.csv").write_text(table(columns))
    cut = load(tmp_path / "rec.csv", reading=Reading(from_=5.5, to=6.5))
    assert np.array_equal(cut.q, r.q[50:151])
    assert (cut.time[0], cut.time[-1]) == (5.5, 6.5)
    with pytest.raises(InputError, match=r"column q_1, row 200 \(line 201\)"):
        load(tmp_path / "rec.csv", reading=Reading(from_=6.0))
    with pytest.raises(InputError, match=r"0 rows between --from 8 .* its time goes from 5 to 6\.99 s"):
        load(tmp_path / "rec.csv", reading=Reading(from_=8.0))
    with pytest.raises(InputError, match="--from must be before --to"):
        Reading(from_=2.0, to=1.0)


def canonical(r: Recording, **changed) -> dict[str, np.ndarray]:
    columns = {"time": r.time} | numbered("q_{j}", r.q, 1) | numbered("dq_{j}", r.qd, 1)
    return columns | numbered("tau_{j}", r.tau, 1) | changed


def test_what_is_not_said_is_taken_as_ever(tmp_path):
    r = made()
    columns = {
        ("t" if name == "time" else name): 1e3 ** (name == "time") * x for name, x in canonical(r).items()
    }
    (tmp_path / "log.csv").write_text(table(columns))
    np.savez(tmp_path / "log.npz", stamp=1e3 * r.time, q=r.q, qd=r.qd, tau=r.tau)
    for name, time in (("log.csv", "t:ms"), ("log.npz", "stamp:ms")):
        assert_same(load(tmp_path / name, columns={"time": time}), r)


def test_a_joint_s_column_has_a_unit_of_its_own(tmp_path):
    r = made()
    columns = canonical(r) | {"q_1": np.rad2deg(r.q[:, 0])}
    (tmp_path / "log.csv").write_text(table(columns))
    assert_same(load(tmp_path / "log.csv", columns={"q_1": "q_1:deg"}), r, atol=1e-15)


def test_text_in_a_column_that_is_not_taken_is_no_matter_and_one_that_is_names_its_row(tmp_path):
    r, lines = made(), table(canonical(made())).splitlines()
    (tmp_path / "log.csv").write_text("\n".join([lines[0] + ",mode", *(line + ",RUN" for line in lines[1:])]))
    read = load(tmp_path / "log.csv")
    assert_same(read, r)
    assert any("mode" in note for note in read.notes)
    lines[5] = "x" + lines[5]
    (tmp_path / "log.csv").write_text("\n".join([lines[0] + ",mode", *(line + ",RUN" for line in lines[1:])]))
    with pytest.raises(InputError, match=r"column time, row 5 \(line 6\)"):
        load(tmp_path / "log.csv")


def test_what_python_takes_for_a_number_and_numpy_does_not_is_a_sentence(tmp_path):
    (tmp_path / "log.csv").write_text(table(canonical(made())).replace("\n0.0,", "\n0_0.0,", 1))
    with pytest.raises(InputError, match="cannot be read as numbers"):
        load(tmp_path / "log.csv")


def test_rostopic_s_header_is_a_comment_above_rows_with_text(tmp_path):
    r = made()
    columns = {"time": np.round(1e9 * r.time)} | numbered("field.position{j}", r.q)
    lines = table(columns, comment="%").splitlines()
    named = [lines[0] + ",field.name0", *(line + ",joint_1" for line in lines[1:])]
    (tmp_path / "log.csv").write_text("\n".join(named))
    with pytest.raises(InputError, match=r"perhaps --columns time=time q=field.position\{j\}"):
        load(tmp_path / "log.csv")
    read = load(tmp_path / "log.csv", columns={"time": "time:ns", "q": "field.position{j}"})
    np.testing.assert_allclose(read.q, r.q)


def test_a_last_line_that_was_cut_off_is_told_as_that(tmp_path):
    text = table(canonical(made()))
    (tmp_path / "log.csv").write_text(text[: text.rindex(",")].rstrip())
    with pytest.raises(InputError, match="the last line was cut off: take it away"):
        load(tmp_path / "log.csv")


def test_a_spreadsheet_s_first_line_is_no_header(tmp_path):
    (tmp_path / "log.csv").write_text("sep=;\n" + table(canonical(made()), ";"))
    assert_same(load(tmp_path / "log.csv"), made())


def test_a_unit_in_a_column_s_name_is_proposed_and_not_read_past(tmp_path):
    r = made()
    columns = {"time [ms]": 1e3 * r.time} | numbered("q_{j} [deg]", np.rad2deg(r.q), 1)
    (tmp_path / "log.csv").write_text(table(columns))
    with pytest.raises(InputError, match=r"'time=time \[ms\]:ms' 'q=q_\{j\} \[deg\]:deg'"):
        load(tmp_path / "log.csv")
    with pytest.raises(InputError, match=r"say q=q_\{j\} \[deg\]:deg, or :rad if it is not in deg"):
        load(tmp_path / "log.csv", columns={"time": "time [ms]:ms", "q": "q_{j} [deg]"})
    read = load(tmp_path / "log.csv", columns={"time": "time [ms]:ms", "q": "q_{j} [deg]:deg"})
    np.testing.assert_allclose(read.q, r.q)


def test_seconds_in_a_log_whose_source_writes_milliseconds_are_told(tmp_path):
    r = made()
    columns = {"time": r.time} | numbered("q_{j}", r.q) | numbered("tau_J_{j}", r.tau)
    (tmp_path / "log.csv").write_text(table(columns))
    with pytest.raises(InputError, match=r"looks like seconds .*--columns time=time:s"):
        load(tmp_path / "log.csv")
    np.testing.assert_allclose(load(tmp_path / "log.csv", columns={"time": "time:s"}).time, r.time)


@pytest.mark.parametrize("name", ["log.csv", "log.npz"])
def test_a_torque_that_is_zero_throughout_was_not_measured(tmp_path, name):
    r = made()
    (tmp_path / "log.csv").write_text(table(canonical(r) | numbered("tau_{j}", 0 * r.tau, 1)))
    np.savez(tmp_path / "log.npz", time=r.time, q=r.q, dq=r.qd, tau=0 * r.tau)
    read = load(tmp_path / name)
    assert read.tau is None
    assert any("tau is 0 throughout" in note for note in read.notes)


def test_arrays_that_are_not_taken_are_named(tmp_path):
    r = made()
    np.savez(tmp_path / "log.npz", time=r.time, q=r.q, effort=r.tau)
    assert any("effort" in note for note in load(tmp_path / "log.npz").notes)
    np.savez(tmp_path / "turned.npz", time=r.time, q=r.q.T)
    with pytest.raises(InputError, match="joints\\) is needed: transpose it"):
        load(tmp_path / "turned.npz")


@pytest.mark.parametrize(("row", "stamp", "part"), [(-1, 150000.0, "--to"), (0, -1.7e9, "--from")])
def test_a_stamp_far_from_all_others_is_refused_before_the_time_between_is_filled(tmp_path, row, stamp, part):
    r = made()
    time = r.time.copy()
    time[row] = stamp
    (tmp_path / "log.csv").write_text(table(canonical(r, time=time)))
    with pytest.raises(InputError, match=rf"time jumps from .*{part}"):
        load(tmp_path / "log.csv")


def test_wrapped_angles_that_were_resampled_are_refused(tmp_path):
    t = np.arange(2000) / 250
    q = 2.5 + 0.2 * t
    wrapped = (q + np.pi) % (2 * np.pi) - np.pi
    at = int(np.argmax(np.abs(np.diff(wrapped)) > 3))
    wrapped[at + 1] = 0.3
    np.savez(tmp_path / "log.npz", time=t, q=np.stack([wrapped, np.sin(t)], 1))
    with pytest.raises(InputError, match="as where wrapped angles were resampled"):
        load(tmp_path / "log.npz")


@pytest.mark.parametrize("off", [-0.4, 2 * np.pi])
@pytest.mark.parametrize(("row", "part"), [(-1, "--to"), (0, "--from")])
def test_a_bad_position_in_the_first_or_last_row_is_cut_off_by_what_the_message_says(
    tmp_path, row, part, off
):
    r = made()
    q = r.q.copy()
    q[row, 1] += off
    np.savez(tmp_path / "log.npz", time=r.time, q=q)
    with pytest.raises(InputError, match=rf"leave those rows out \({part} ([\d.]+)\)") as error:
        load(tmp_path / "log.npz")
    at = float(str(error.value).split(part)[1].rstrip(")"))
    reading = Reading(to=at) if part == "--to" else Reading(from_=at)
    assert load(tmp_path / "log.npz", reading=reading).samples == r.samples - 1


def test_a_file_of_raw_logs_has_a_unit(tmp_path):
    r = made()
    np.savetxt(tmp_path / "time.txt", 1e3 * r.time)
    np.savetxt(tmp_path / "q.txt", r.q)
    with pytest.raises(InputError, match="milliseconds"):
        load(tmp_path)
    np.testing.assert_allclose(load(tmp_path, columns={"time": "time.txt:ms"}).time, r.time)


def test_options_that_choose_nothing_are_refused(tmp_path):
    (tmp_path / "rec.csv").write_text(table({"time": made().time} | numbered("q_{j}", made().q, 1)))
    for reading in (Reading(topic="/joint_states"), Reading(episode=("1",))):
        with pytest.raises(InputError, match="chooses nothing in it"):
            load(tmp_path / "rec.csv", reading=reading)


def test_the_kinova_s_real_log_reads_as_its_proposal_says(data):
    with pytest.raises(InputError) as raised:
        load(data / "kinova_gen3" / "opti_traj_testing2.csv.gz")
    proposed = str(raised.value).split("--columns ")[1]
    assert proposed == "time=Time q=Position{j} dq=Velocity{j} tau=Torque{j}"
    with pytest.raises(InputError, match="looks like milliseconds"):
        load(data / "kinova_gen3" / "opti_traj_testing2.csv.gz", reading=Reading(tuple(proposed.split())))
    read = load(
        data / "kinova_gen3" / "opti_traj_testing2.csv.gz",
        reading=Reading(tuple(proposed.replace("time=Time", "time=Time:ms").split())),
    )
    assert (read.samples, read.dof, round(read.rate)) == (2294, 7, 1000)


@pytest.mark.parametrize("name", ["gaz_panda", "iiwa/J3_chirp", "ur10e/ur-20_02_19_14harm50sec.csv.gz"])
def test_a_real_log_converted_reads_back_the_same(data, tmp_path, name):
    """Ticks that were reconstructed, and stamps that say when samples were taken, stay as they are."""
    columns = ("time=1", "q=2..7", "dq=8..13", "tau=14..19") if name.startswith("ur10e") else ()
    read = load(data / name, reading=Reading(columns))
    save(read, tmp_path / "rec.csv")
    back = load(tmp_path / "rec.csv")
    for ours, theirs in zip([back.time, *back.channels()], [read.time, *read.channels()], strict=True):
        assert np.array_equal(ours, theirs)


def test_the_ur10e_s_real_log_has_no_header(data):
    columns = ("time=1", "q=2..7", "dq=8..13", "tau=14..19")
    read = load(data / "ur10e" / "ur-20_02_19_14harm50sec.csv.gz", reading=Reading(columns))
    assert (read.samples, read.dof, round(read.rate)) == (5375, 6, 100)


def test_a_slide_in_millimetres_is_said_of_that_joint_alone(tmp_path):
    r, slides = made(), np.arange(7) == 1
    r = dataclasses.replace(r, q=np.where(slides, 0.1 * r.q, r.q), qd=np.where(slides, 0.1 * r.qd, r.qd))
    columns = {"time": r.time} | numbered("q_{j}", np.where(slides, 1000 * r.q, r.q), 1)
    columns |= numbered("dq_{j}", np.where(slides, 1000 * r.qd, r.qd), 1) | numbered("tau_{j}", r.tau, 1)
    (tmp_path / "rec.csv").write_text(table(columns))
    with pytest.raises(InputError, match=r"of one joint q_2=q_2:mm"):
        load(tmp_path / "rec.csv")
    read = load(tmp_path / "rec.csv", reading=Reading(("q_2=q_2:mm", "dq_2=dq_2:mm/s")))
    np.testing.assert_allclose(read.q, r.q, rtol=1e-12)
    np.testing.assert_allclose(read.qd, r.qd, rtol=1e-12)
