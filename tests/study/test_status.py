"""How far runs are."""

import fcntl
import json

from study.status import main, status


def test_states_and_time_left(tmp_path, monkeypatch, capsys):
    folders = [tmp_path / f"x/door-v0/beta_0/n_envs_4/seed_{seed}" for seed in range(4)]
    folders.append(tmp_path / "x/Ant-v5/beta_0/n_envs_4/seed_0")
    done, running, failed, _, other = folders
    for folder in (done, running, failed, other):
        folder.mkdir(parents=True)
        (folder / "lock").touch()
        (folder / "config.json").touch()
    (failed / "failed").touch()
    assert status(folders, "x") == "x: 0 of 5 done, 0 running, 1 failed, 4 to do"
    (done / "summary.json").write_text(json.dumps({"wall_seconds": 5400.0}))
    (other / "summary.json").write_text(json.dumps({"wall_seconds": 36000.0}))
    counts = "x: 2 of 5 done, 0 running, 1 failed, 2 to do"
    assert status(folders, "x") == f"{counts}, 3.0 hours left with 1 at a time"
    with open(running / "lock") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        # Half of the running one and all of the other, at the door's 1.5 h
        counts = "x: 2 of 5 done, 1 running, 1 failed, 1 to do"
        assert status(folders, "x") == f"{counts}, 2.2 hours left with 1 at a time"
        monkeypatch.setattr("sys.argv", ["status", str(tmp_path)])
        main()
    # A folder of runs: those that are there
    assert f"{tmp_path}: 2 of 4 done, 1 running, 1 failed, 0 to do" in capsys.readouterr().out
