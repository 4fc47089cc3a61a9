"""How far runs are."""

import fcntl
import json

from study.status import main, status


def test_states_and_time_left(tmp_path, monkeypatch, capsys):
    runs = tmp_path / "x/door-v0/beta_0"
    folders = [runs / f"n_envs_4/seed_{seed}" for seed in range(4)]
    done, running, failed, _ = folders
    for folder in folders[:3]:
        folder.mkdir(parents=True)
        (folder / "lock").touch()
        (folder / "config.json").write_text(json.dumps({"args": {"total_timesteps": 1000}}))
    (failed / "failed").touch()
    assert status(folders, "x")[0] == "x: 0 of 4 done, 0 running, 1 failed, 3 to do"
    (done / "summary.json").write_text(json.dumps({"steps": 8, "wall_seconds": 5400.0}))
    head = "x: 1 of 4 done, 0 running, 1 failed, 2 to do"
    assert status(folders, "x")[0] == f"{head}, 3.0 h of one core left"
    (running / "evaluations.csv").write_text("step,return_mean\n100,1\n600,1\n")
    with open(running / "lock") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        head, _, row = status(folders, "x")
        monkeypatch.setattr("sys.argv", ["status", str(tmp_path)])
        main()
    # 0.4 of the running one is left and all of the other, at 1.5 h each
    counts = "x: 1 of 4 done, 1 running, 1 failed, 1 to do"
    assert head == f"{counts}, 2.1 h left at the present rate"
    assert row.split() == ["door-v0", "1", "1", "1", "1", "1.5", "h", "2.1", "h"]
    # A folder of runs: those that are there
    head, _, row = capsys.readouterr().out.splitlines()
    assert head.startswith(f"{tmp_path}: 1 of 3 done, 1 running, 1 failed, 0 to do")
