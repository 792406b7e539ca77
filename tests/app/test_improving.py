"""The parts that a record was made with are found by themselves, and no others."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import pytest
from rich.console import Console

import bwbayes as bw
from bwbayes.app.config.config import Config
from bwbayes.app.config.settings import RecordConfig
from bwbayes.app.running.explaining import improve_model
from bwbayes.errors import InputError, InputWarning
from bwbayes.record import write_record
from tests.diagnosis.plants import plant

QUIET = Console(quiet=True)


def config_of(kind: str, folder: Path, seed: int = 1) -> Config:
    write_record(plant(kind, (8, seed), 8.0), folder / "record.h5")
    return Config(record=RecordConfig(file="record.h5", from_rest=True, train=[[0.0, 6.0]]))


def test_a_quadratic_gain_is_added(tmp_path: Path) -> None:
    improved = improve_model(config_of("quadratic", tmp_path), tmp_path, QUIET)
    assert "quadratic" in improved.model.gain
    (note,) = improved.records["record"].remarks or [""]
    assert re.match(r"model improved: quadratic.* nats, RMSE .* um\); set gain", note)


@pytest.mark.slow
def test_a_quadratic_gain_is_added_and_the_run_says_what_it_is_worth() -> None:
    record = plant("quadratic", (8, 1), 8.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        fit = bw.fit(
            record,
            improve=True,
            from_rest=True,
            train=(0.0, 6.0),
            validation={"rest": (6.0, 8.0)},
            ess=500,
            progress=False,
        )
    (note,) = [str(w.message) for w in caught if "model improved" in str(w.message)]
    assert re.match(
        r"model improved: quadratic.* nats, RMSE .* um, held out .* um\); set gain", note
    )
    assert "quadratic" in fit.problem.config.model.gain
    assert fit.verdicts["rest"].holds is not False


@pytest.mark.parametrize("kind", [pytest.param("good", marks=pytest.mark.slow), "transient"])
def test_nothing_is_added_to_a_right_model_or_for_what_the_actuator_did_not_do(
    kind: str, tmp_path: Path
) -> None:
    """The twin: a transient of many nats, which parts of a model could follow."""
    config = config_of(kind, tmp_path)
    assert improve_model(config, tmp_path, QUIET) == config


def test_several_records_are_refused_in_one_line(tmp_path: Path) -> None:
    config_of("good", tmp_path)
    record = RecordConfig(file="record.h5", from_rest=True)
    with pytest.raises(InputError, match="improve: is for one training record"):
        improve_model(Config(record={"first": record, "second": record}), tmp_path, QUIET)
