"""A campaign: every record in the table, however it ended; interrupted, continued, added to."""

import csv
import json
import shutil
import tomllib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import bwbayes as bw
from bwbayes.app.commands.cli import cli
from bwbayes.app.config.config import load, parse
from bwbayes.app.jobs import campaign as module
from bwbayes.app.jobs.campaign import Campaign, Row, config_text, resume, start
from bwbayes.app.running.folder import CampaignFolder, RunFolder
from bwbayes.app.running.progress import batch
from bwbayes.app.running.run import resume as resume_run
from bwbayes.app.study.resolve import resolve_config
from bwbayes.errors import InputError, InputWarning
from bwbayes.report.result import summary, write_summary
from tests.app import small
from tests.app.conftest import Type
from tests.app.specimens import CONFIG, record, specimens
from tests.app.steps import Steps
from tests.forks import FORKS

COUNT = 3
FILES = ("campaign.json", "campaign.csv", "campaign.html", "figures/parameters.png")
BROKEN = "time_s,voltage_V,displacement_um\n0,0,x\n"


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return three good records, one that is broken, two of one name, and a config; for reading."""
    path = tmp_path_factory.mktemp("given")
    specimens(path / "records", COUNT)
    for name in ("broken.csv", "twice.csv", "twice.h5"):
        (path / "records" / name).write_text(BROKEN)
    (path / "records/notes.md").write_text("no record")
    (path / "small.toml").write_text(CONFIG)
    return path


def begun(given: Path, path: Path, **options: Any) -> CampaignFolder:
    config = config_text(given / "small.toml")
    return start(given / "records", config, given, path, **{"pictures": False, **options})


def ended(folder: CampaignFolder, **options: Any) -> Campaign:
    return resume(folder, small.quiet(), **{"workers": 1, **options})


@pytest.fixture(scope="module")
def whole(given: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the campaign made by its command in one piece, in this process; for reading."""
    path = tmp_path_factory.mktemp("whole") / "batch"
    command = "campaign", "records", "--config", "small.toml", "--no-pictures", "--workers", "1"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(given)
        small.without_explanations(patch)
        done = CliRunner().invoke(cli, [*command, "--out", str(path)], standalone_mode=False)
    assert 2 == done.return_value, done.output
    assert "REFUSED: broken: broken.csv:2:" in done.stderr
    assert "6 records: 3 refused, 3 passed" in done.stdout
    return path


def rows(path: Path) -> dict[str, dict[str, str]]:
    with (path / "campaign.csv").open(encoding="utf-8") as file:
        return {row["record"]: row for row in csv.DictReader(file)}


def assert_same_end(expected: Path, got: Path) -> None:
    for name in FILES:
        assert (expected / name).read_bytes() == (got / name).read_bytes(), name


def test_every_record_has_a_row_and_a_run_of_its_own(whole: Path) -> None:
    table = rows(whole)
    assert ["broken", "s000", "s001", "s002", "twice"] == list(table)
    assert "refused" == table["broken"]["status"] == table["twice"]["status"]
    assert "twice.h5: shares its name with another record" in table["twice"]["reason"]
    assert "broken.csv:2: displacement_um: 'x' is not a number" in table["broken"]["reason"]
    summary = json.loads((whole / "campaign.json").read_text())
    assert {
        "refused": 3,
        "not converged": 0,
        "validation failed": 0,
        "validation inconclusive": 0,
        "passed": COUNT,
    } == (summary["counts"])
    for name in list(table)[1:-1]:
        own = json.loads((whole / f"records/{name}/summary.json").read_text())
        for key in ("mean", "lower_95"):
            number = own["parameters"]["d"][key]
            assert float(table[name][f"d_{key}_um/V"]) == pytest.approx(number, rel=1e-6)
            assert number == summary["records"][name]["parameters"]["d"][key]


@pytest.mark.usefixtures("_without_explanations")
def test_a_records_run_is_what_the_run_command_makes(
    given: Path, whole: Path, tmp_path: Path
) -> None:
    """But for a search for stages: all records of a campaign have the same model."""
    file = given / "records/s000.csv"
    text = CONFIG.replace("[record]", f'[record]\nfile = "{file}"')
    config = parse(text, "alone").with_search("none")
    alone = resume_run(
        RunFolder.create(tmp_path / "alone", resolve_config(config, given)),
        small.quiet(),
        workers=1,
        files=False,
    )
    own = json.loads((whole / "records/s000/summary.json").read_text())
    write_summary(tmp_path / "alone.json", summary(alone.result))
    for key, value in json.loads((tmp_path / "alone.json").read_text()).items():
        assert value == own[key], key


def test_columns_and_units_of_all_records_are_said_once(bwbayes: Type, tmp_path: Path) -> None:
    """By the options of other commands; a config's are its keys, and a campaign's do not change."""
    folder, batch = tmp_path / "records", tmp_path / "batch"
    folder.mkdir()
    stand = record(0)
    for name in ("a", "b"):
        table = np.column_stack([stand.voltage, 1e3 * np.asarray(stand.displacement)])
        np.savetxt(folder / f"{name}.csv", table, delimiter=";", header=f"Monitor;{name}")
    (tmp_path / "small.toml").write_text(CONFIG)
    command = ("campaign", folder, "--out", batch, "--unit", "displacement=V")
    assert "units: displacement in 'V' is unknown" in bwbayes(*command).err
    said = bwbayes(*command, "--config", tmp_path / "small.toml")
    assert "in a config say columns, units" in said.err
    said = bwbayes("campaign", "--resume", batch, "--fs", "3")
    assert "--table are for a file; give a FOLDER of records" in said.err
    reading = {
        "columns": {"voltage": "1", "displacement": "2"},
        "units": {"voltage": "V", "displacement": "nm"},
        "fs": 1 / stand.interval,
    }
    for name in ("a", "b"):
        origin = start(folder, "", tmp_path, batch, reading=reading)
        read = module._begun_run(folder / f"{name}.csv", origin).study.record
        np.testing.assert_allclose(
            np.asarray(read.displacement), np.asarray(stand.displacement), atol=1e-9
        )
        assert read.interval == pytest.approx(stand.interval)
    with pytest.raises(InputError, match="a campaign of another config"):
        start(folder, "", tmp_path, batch, reading={**reading, "fs": 3.0})


def test_a_campaign_tells_what_share_of_its_combining_is_done(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(whole, tmp_path / "again")
    steps = Steps.of_commands(monkeypatch)
    ended(CampaignFolder.open(tmp_path / "again"))
    steps.require("results", "draws", "population", "figures")


def unexplained() -> None:
    small.without_explanations(pytest.MonkeyPatch())


def test_runs_that_were_not_seen_to_end_are_done_again_and_no_others(
    given: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In another process, and in the same bytes."""
    shutil.copytree(whole, tmp_path / "batch")
    asked: list[list[str]] = []

    def noted(call: Any, tasks: list[tuple[Path, Any]], *rest: Any, **options: Any) -> Any:
        asked.append([file.stem for file, *_ in tasks])
        return batch(call, tasks, *rest, **options)

    monkeypatch.setattr(module, "batch", noted)
    folder = begun(given, tmp_path / "batch")
    mark, file = folder.run("s002") / "ended.json", given / "records/s002.csv"
    mark.write_bytes(mark.read_bytes()[:30])
    assert not folder.is_done(file)
    with ProcessPoolExecutor(1, FORKS, initializer=unexplained) as pool:
        ended(folder, executor=pool)
    assert [["broken", "s002"]] == asked
    assert folder.is_done(file)
    assert_same_end(whole, folder.path)


@pytest.mark.usefixtures("_without_explanations", "_without_pictures")
def test_a_run_whose_noise_was_chosen_goes_on(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(CONFIG.replace('noise = "white"', 'noise = "auto"'))
    specimens(tmp_path / "records", 1)
    folder = begun(tmp_path, tmp_path / "batch")
    assert ended(folder).exit_status == 0
    run = folder.run("s000")
    assert load(run / "config.toml").model.noise != "auto"
    before = (run / "chain").stat().st_mtime_ns
    (run / "ended.json").unlink()
    assert ended(folder).exit_status == 0
    assert before == (run / "chain").stat().st_mtime_ns


@pytest.mark.usefixtures("_without_explanations", "_without_pictures")
def test_added_changed_and_repaired_records_are_fitted_alone(given: Path, tmp_path: Path) -> None:
    shutil.copytree(given, tmp_path / "given", ignore=shutil.ignore_patterns("twice.*"))
    folder = begun(tmp_path / "given", tmp_path / "batch")
    first = ended(folder)
    records = tmp_path / "given/records"
    bw.write_record(record(17), records / "new.csv")
    bw.write_record(record(18), records / "s001.csv")
    shutil.copyfile(records / "s000.csv", records / "broken.csv")
    (records / "s002.csv").unlink()
    before = {path: path.stat().st_mtime_ns for path in folder.path.glob("records/*/chain")}
    second = ended(folder)
    assert 0 == second.exit_status
    assert ["broken", "new", "s000", "s001"] == [row.name for row in second.rows]
    kept = [path.parent.name for path in before if path.stat().st_mtime_ns == before[path]]
    assert ["s000", "s002"] == sorted(kept)
    means = [
        {r.name: r.parameters["d"]["mean"] for r in c.rows if r.parameters} for c in (first, second)
    ]
    assert means[0]["s001"] != means[1]["s001"]
    assert means[1]["s000"] == means[1]["broken"]


@pytest.mark.usefixtures("_without_explanations", "_without_pictures")
def test_a_record_whose_validation_file_was_changed_is_fitted_again(tmp_path: Path) -> None:
    """Its bands are those of the file as it is; a campaign that is finished would not look."""
    (tmp_path / "small.toml").write_text(CONFIG + '[validation.next]\nfile = "next.csv"\n')
    specimens(tmp_path / "records", 1)
    bw.write_record(record(0), tmp_path / "next.csv")
    folder = begun(tmp_path, tmp_path / "batch")
    assert ended(folder).exit_status == 0
    first = folder.run("s000")
    assert folder.is_done(tmp_path / "records/s000.csv")
    before = json.loads((first / "summary.json").read_text())["validation"]["next"]
    other = record(0)
    assert other.displacement is not None
    bw.write_record(replace(other, displacement=1.2 * other.displacement), tmp_path / "next.csv")
    assert not folder.is_done(tmp_path / "records/s000.csv")
    assert ended(folder).exit_status == 3
    after = json.loads((first / "summary.json").read_text())["validation"]["next"]
    assert (True, False) == (before["passed"], after["passed"])


def test_the_worst_ending_is_the_exit_status() -> None:
    endings = ["passed", "validation inconclusive", "validation failed", "not converged", "refused"]
    rows = tuple(Row(ending, "x.csv", ending, "why", {}) for ending in endings)
    made = [Campaign(CampaignFolder(Path("x")), rows[:n], "few") for n in range(1, 6)]
    assert [0, 5, 3, 4, 2] == [campaign.exit_status for campaign in made]


def test_another_config_or_folder_is_refused(given: Path, whole: Path, tmp_path: Path) -> None:
    (tmp_path / "other.toml").write_text(CONFIG.replace("seed = 3", "seed = 4"))
    with pytest.raises(InputError, match="is a campaign of another config or other records"):
        start(given / "records", config_text(tmp_path / "other.toml"), given, whole, pictures=False)
    with pytest.raises(InputError, match="no campaign here"):
        start(given / "records", "", given, given)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="has no record"):
        start(tmp_path / "empty", "", given, tmp_path / "batch")


def test_python_has_table_population_and_the_next_specimen(
    given: Path, whole: Path, tmp_path: Path
) -> None:
    """It is read from a campaign's folder; it warns of what is short."""
    shutil.copytree(whole, tmp_path / "batch")
    with pytest.warns(InputWarning) as warned:
        campaign = bw.campaign(
            given / "records",
            config=given / "small.toml",
            folder=tmp_path / "batch",
            progress=False,
            workers=1,
        )
    assert str(warned[0].message).startswith("broken: refused: broken.csv:2")
    assert 2 == len(warned)
    assert ["broken", "s000", "s001", "s002", "twice", "twice"] == list(campaign.table.index)
    assert {"d", "alpha"} == set(campaign.population.parameters)
    assert {"d", "alpha"} == set(campaign.population.to_pandas().index)  # type: ignore[attr-defined]
    assert ({"broken", "twice"}, {}) == (set(campaign.short), campaign.outliers)
    # A specimen that was not measured is less sure than one that was.
    planned = replace(record(9), displacement=None)
    bands = campaign.predict(planned, from_rest=True)
    own = campaign.fit("s001").predict(planned, from_rest=True)
    wide, narrow = (
        np.mean(b.upper["parameter", 95] - b.lower["parameter", 95]) for b in (bands, own)
    )
    assert wide > 5 * narrow
    assert repr(campaign).startswith("6 records: 3 refused, 3 passed")
    assert campaign.plot().axes


@pytest.mark.usefixtures("_without_explanations", "_without_pictures")
def test_python_fits_records_by_name(tmp_path: Path) -> None:
    keys = tomllib.loads(CONFIG)
    keys |= keys.pop("model") | keys.pop("sampling")
    del keys["record"]
    campaign = bw.campaign({"r0": record(0)}, progress=False, workers=1, **keys)
    assert campaign.fit("r0").converged
    with pytest.raises(InputError, match="no population: a population needs 3 records or more"):
        _ = campaign.population
    with pytest.raises(InputError, match="either config or keys"):
        bw.campaign(tmp_path, config="x.toml", dynamics="none")
