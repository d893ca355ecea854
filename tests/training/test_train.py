"""Training: the network learns, and an interrupted run ends with the same model as an uninterrupted one."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import feature_names, from_angles_deg
from modsoft.runtime.errors import InUse, ModelError, TargetNotReached, UsageError
from modsoft.training import checkpoint as checkpoints
from modsoft.training import fit, settings, train
from modsoft.training.data import dataset
from modsoft.training.fit import CHECKS, PATIENCE, charbonnier_loss, estimation_errors, last_modules, one_cycle
from modsoft.training.settings import DEVICES, PRECISIONS, Settings

pytestmark = pytest.mark.instructions

SMALL = Settings(history=3, iterations=60, batch=32, layers=2, hidden=8)


def make(episodes: int = 10, steps: int = 30, seed: int = 0) -> dataset.DataSet:
    """A robot whose modules bend at once by 40 degrees times their action, less 10 times the next module's."""
    robot = robot_file.load("pneumatic-3")
    action = np.random.default_rng(seed).uniform(-1, 1, (episodes, steps, 3, 1))
    angles = np.zeros((episodes, steps + 1, 3))
    angles[:, 1:] = 40 * action[..., 0] - 10 * np.roll(action[..., 0], -1, axis=-1)
    return dataset.DataSet(
        generation={"robot": robot.to_dict(), "strategy": "random", "seed": seed, "steps": steps},
        configuration=from_angles_deg(angles),
        action=action,
        stage_borders=np.array([0, steps]),
        rejected=0,
    )


def equal(one: dict, other: dict) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def test_network_learns_and_the_checkpoint_describes_the_run(tmp_path):
    out = tmp_path / "model.pt"
    data = make(20)
    reports = []
    train.train(
        [data], out, dataclasses.replace(SMALL, iterations=600, learning_rate=0.01, dropout=0.0), reports.append
    )
    assert list(tmp_path.iterdir()) == [out]
    trained = checkpoints.load(out)
    assert robot_file.from_dict(trained["robot"]) == data.robot
    assert trained["features"] == feature_names("planar", 3)
    assert trained["network"]["history"] == 3
    assert trained["provenance"]["data_sha256"] == data.sha256()
    assert trained["provenance"]["samples"] == 600
    # Guessing 0 would be 25 percent of the range in the mean.
    errors = trained["provenance"]["errors_percent"]
    assert len(errors) == len(trained["provenance"]["errors_std_percent"]) == 3
    assert max(errors) < 5.0
    # and they are those of the weights in the file, on the test part
    _, _, test = dataset.split(data, 3, "blocks", 0)
    again = estimation_errors(checkpoints.network_of(trained), test)
    np.testing.assert_allclose(again.mean(dim=(0, 2)).numpy(), errors, atol=1e-3)
    assert [t.iteration for t in reports] == list(range(1, 601))
    assert reports[-1].progress == 1.0
    assert np.mean([t.loss for t in reports[-50:]]) < 0.05 * reports[0].loss


def test_loss_is_the_mean_error_and_smooth_at_zero():
    true = torch.tensor([0.5, -0.5])
    assert charbonnier_loss(true, true) == pytest.approx(0.01)
    assert charbonnier_loss(true + 0.3, true) == pytest.approx(0.3, rel=1e-3)
    small = torch.tensor([1e-4], requires_grad=True)
    charbonnier_loss(small, torch.zeros(1)).backward()
    assert small.grad.item() == pytest.approx(0.01, rel=1e-3)  # not 1: smooth at zero


def test_unknown_precision_is_refused():
    with pytest.raises(UsageError, match="precision 'half', expected one of float32, bfloat16"):
        dataclasses.replace(SMALL, precision="half")


@pytest.mark.skipif(not settings.bfloat16_works("cpu"), reason="the processor has no units for bfloat16")
def test_bfloat16_products_train_as_well(tmp_path):
    changed = dataclasses.replace(SMALL, iterations=600, learning_rate=0.01)
    errors = {}
    for precision in PRECISIONS:
        checkpoint = train.train(
            [make(20)], tmp_path / f"{precision}.pt", dataclasses.replace(changed, precision=precision)
        )
        assert {value.dtype for value in checkpoint["weights"].values()} == {torch.float32}
        errors[precision] = np.mean(checkpoint["provenance"]["errors_percent"])
    assert 0.0 < abs(errors["bfloat16"] - errors["float32"]) < 1.0
    assert max(errors.values()) < 5.0


def test_precision_or_device_that_the_machine_does_not_have_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(settings, "bfloat16_works", lambda device: False)
    with pytest.raises(UsageError, match="precision bfloat16: this machine has no units for it; give --precision"):
        settings.settings_for("cables", {"precision": "bfloat16"})
    assert settings.fastest_precision() == "float32"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UsageError, match="device cuda: torch finds no GPU"):
        train.train([make()], tmp_path / "model.pt", dataclasses.replace(SMALL, device="cuda"))
    assert not list(tmp_path.iterdir())


def test_default_device_is_the_gpu_where_there_is_one(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert settings.settings_for("cables", {"device": "auto", "learning_rate": None}) == Settings(5, batch=64)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    chosen = settings.settings_for("chambers", {"device": "auto"})
    assert (chosen.device, chosen.batch, chosen.truncation_probability) == ("cuda", 512, 0.4)
    chosen = settings.settings_for("chambers", {"device": "cpu", "network": "lstm", "history": 7})
    assert (chosen.device, chosen.batch, chosen.truncation_probability, chosen.history) == ("cpu", 128, 0.0, 7)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_gpu_gives_the_same_model_within_rounding(tmp_path):
    trained = {}
    for device in DEVICES:
        changed = dataclasses.replace(SMALL, device=device, iterations=100, learning_rate=0.01)
        trained[device] = train.train([make(20)], tmp_path / f"{device}.pt", changed)["weights"]
        assert {value.device.type for value in trained[device].values()} == {"cpu"}
    for name, value in trained["cpu"].items():
        torch.testing.assert_close(trained["cuda"][name], value, atol=0.01, rtol=0.01)


def test_run_ends_as_soon_as_its_target_is_reached(tmp_path):
    steps = []
    changed = dataclasses.replace(SMALL, iterations=600, learning_rate=0.01, target_percent=10.0)
    trained = train.train([make(20)], tmp_path / "model.pt", changed, steps.append)["provenance"]
    assert trained["validation_percent"] <= 10.0
    assert trained["iterations_done"] == len(steps) < 600
    assert steps[-1].validation_percent > 10.0, "the check after that step is the first that reaches it"


def test_run_above_its_target_keeps_the_model_and_is_reported_every_time(tmp_path):
    out = tmp_path / "model.pt"
    changed = dataclasses.replace(SMALL, target_percent=0.01)
    for _ in range(2):
        with pytest.raises(TargetNotReached, match=r"validation error .* % after 60 iterations .* at most 0.01 %"):
            train.train([make()], out, changed)
        assert list(tmp_path.iterdir()) == [out]
        assert checkpoints.load(out)["provenance"]["iterations_done"] == 60


def test_interrupted_run_of_another_optimizer_is_refused(tmp_path, monkeypatch):
    out = tmp_path / "model.pt"
    with pytest.raises(Cut):
        train.train([make()], out, SMALL, cut_at(7))
    monkeypatch.setattr(train.optimizer, "DESCRIPTION", "another")
    with pytest.raises(ModelError, match=r"model.pt.resume: of a run with optimizer muon.*, expected another"):
        train.train([make()], out, SMALL)


@pytest.mark.parametrize("network", ["lstm", "module-lstm"])
def test_networks_bound_to_a_module_number_learn(tmp_path, network):
    data = make(20)
    changed = dataclasses.replace(SMALL, network=network, iterations=600, learning_rate=0.01, dropout=0.0)
    trained = train.train([data], tmp_path / "model.pt", changed)
    assert (trained["network"]["name"], trained["network"]["modules"]) == (network, 3)
    assert trained["provenance"]["network"] == network
    # A guess has 25 percent. A module's own angle does not show the up to 10 of 40 degrees from its neighbour.
    assert max(trained["provenance"]["errors_percent"]) < (5.0 if network == "lstm" else 15.0)
    again = checkpoints.network_of(checkpoints.load(tmp_path / "model.pt"))
    _, _, test = dataset.split(data, 3, "blocks", 0)
    errors = estimation_errors(again, test).mean(dim=(0, 2))
    np.testing.assert_allclose(errors.numpy(), trained["provenance"]["errors_percent"], atol=1e-3)


def test_network_bound_to_a_module_number_refuses_truncation():
    with pytest.raises(UsageError, match=r"--truncation-probability 0\.4: the network lstm is bound"):
        dataclasses.replace(SMALL, network="lstm", truncation_probability=0.4)


def test_weights_depend_on_the_seed_alone(tmp_path):
    one, again, other = (
        train.train([make()], tmp_path / f"{number}.pt", dataclasses.replace(SMALL, seed=seed))["weights"]
        for number, seed in enumerate((0, 0, 1))
    )
    assert equal(one, again)
    assert not equal(one, other)


def test_finished_model_is_kept_and_one_of_other_settings_refused(tmp_path):
    out = tmp_path / "model.pt"
    made, reports = train.train([make()], out, SMALL), []
    before, other = out.read_bytes(), tmp_path / "model.pt.resume"
    other.write_text("not of this training")
    again = train.train([make()], out, SMALL, reports.append)
    assert other.read_text() == "not of this training"
    assert equal(again["weights"], made["weights"])
    assert not reports
    with pytest.raises(ModelError, match=r"exists already, with batch 32, expected 64; give another --out"):
        train.train([make()], out, dataclasses.replace(SMALL, batch=64))
    assert out.read_bytes() == before


@pytest.mark.parametrize("error", [math.nan, 1e9])
def test_diverged_run_leaves_no_file(tmp_path, monkeypatch, error):
    monkeypatch.setattr(fit, "estimation_errors", lambda *_: torch.tensor(error))
    with pytest.raises(ModelError, match="diverged"):
        train.train([make()], tmp_path / "model.pt", SMALL)
    assert not list(tmp_path.iterdir())


def test_second_training_of_the_same_model_is_refused_and_changes_nothing(tmp_path):
    out, refused = tmp_path / "model.pt", []

    def second(now):
        if now.iteration == 5:
            with pytest.raises(InUse, match="another modsoft-train works on it") as error:
                train.train([make()], out, dataclasses.replace(SMALL, seed=2))
            refused.append(error.value.exit_code)

    train.train([make()], out, SMALL, second)
    assert refused == [75]
    assert checkpoints.load(out)["provenance"]["seed"] == SMALL.seed
    assert list(tmp_path.iterdir()) == [out]


def test_all_files_are_written_beside_the_target_of_a_link(tmp_path):
    home, disk = tmp_path / "home", tmp_path / "disk"
    home.mkdir()
    disk.mkdir()
    (home / "model.pt").symlink_to(disk / "m.pt")
    seen = set()
    train.train([make()], home / "model.pt", SMALL, lambda _: seen.update(path.name for path in disk.iterdir()))
    assert seen == {"m.pt.lock", "m.pt.resume"}
    assert [path.name for path in disk.iterdir()] == ["m.pt"]
    assert [path.name for path in home.iterdir()] == ["model.pt"]
    assert (home / "model.pt").is_symlink()


class Cut(Exception):
    """Stands for a kill, which the run cannot handle."""


def cut_at(iteration: int):
    def cut(progress):
        if progress.iteration == iteration:
            raise Cut

    return cut


@pytest.mark.parametrize("iteration", [4, 21, 59])
def test_interrupted_run_ends_with_the_same_weights_bit_for_bit(tmp_path, iteration):
    changed = dataclasses.replace(SMALL, truncation_probability=0.3)
    straight = train.train([make()], tmp_path / "straight.pt", changed)
    out = tmp_path / "cut.pt"
    with pytest.raises(Cut):
        train.train([make()], out, changed, cut_at(iteration))
    assert not out.exists()
    torch.manual_seed(123)  # a new process has another random state
    resumed = []
    trained = train.train([make()], out, changed, resumed.append)
    # From the last check: only the work since then is lost.
    every = changed.iterations // CHECKS
    assert resumed[0].iteration == (iteration - 1) // every * every + 1
    assert equal(trained["weights"], straight["weights"])
    assert trained["provenance"]["errors_percent"] == straight["provenance"]["errors_percent"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.pt", "straight.pt"]


@pytest.mark.parametrize(
    "changes",
    [
        {"identity": 1},
        {"weights": {}},
        {"weights": 1},
        {"optimizer": {}},
        {"checks_without_improvement": "x"},
        {"iteration": -1},
    ],
)
def test_damaged_state_is_one_line(tmp_path, changes):
    out = tmp_path / "model.pt"
    with pytest.raises(Cut):
        train.train([make()], out, SMALL, cut_at(21))
    resume = tmp_path / "model.pt.resume"
    checkpoints.save({**checkpoints.read(resume), **changes}, resume)
    before = resume.read_bytes()
    with pytest.raises(ModelError, match=r"^[^\n]*model\.pt\.resume: [^\n]*delete it to start[^\n]*$"):
        train.train([make()], out, SMALL)
    assert resume.read_bytes() == before
    assert not out.exists()


def test_interrupted_run_of_other_settings_or_data_is_refused(tmp_path):
    out = tmp_path / "model.pt"
    with pytest.raises(Cut):
        train.train([make()], out, SMALL, cut_at(7))
    with pytest.raises(ModelError, match=r"model.pt.resume: of a run with batch 32, expected 64"):
        train.train([make()], out, dataclasses.replace(SMALL, batch=64))
    with pytest.raises(ModelError, match="of a run with data_sha256"):
        train.train([make(seed=1)], out, SMALL)
    resume = tmp_path / "model.pt.resume"
    resume.write_bytes(resume.read_bytes()[:1000])
    with pytest.raises(ModelError, match=r"model.pt.resume: not a checkpoint"):
        train.train([make()], out, SMALL)


def test_early_stopping_keeps_the_best_weights(tmp_path):
    """Random targets: the validation error increases as the network memorises them."""
    data = make()
    data.action[:] = np.random.default_rng(5).uniform(-1, 1, data.action.shape)
    reports = []
    changed = dataclasses.replace(SMALL, iterations=4000, learning_rate=0.02, hidden=32, dropout=0.0)
    trained = train.train([data], tmp_path / "model.pt", changed, reports.append)
    best = trained["provenance"]["validation_percent"]
    first_with_best = next(t.iteration for t in reports if t.validation_percent == best)
    every = changed.iterations // CHECKS
    assert trained["provenance"]["iterations_done"] == first_with_best - 1 + PATIENCE * every < 4000
    _, validation, _ = dataset.split(data, 3, "blocks", 0)
    again = float(estimation_errors(checkpoints.network_of(trained), validation).mean())
    assert again == pytest.approx(best, abs=1e-4)


def test_last_modules_get_the_labels_of_a_robot_of_that_many():
    training, _, _ = dataset.split(make(), 3, "blocks", 0)
    features = torch.from_numpy(training.features)
    two = last_modules(features, 2)
    assert torch.equal(two[..., :-1], features[:, 1:, :-1])
    assert two[0, :, -1].tolist() == [-1.0, 1.0]
    assert torch.equal(last_modules(features, 3), features)


def test_time_budget_ends_the_run_at_progress_1(tmp_path):
    now = iter(np.arange(0.0, 1e6, 0.5))  # every reading of the clock takes half a second
    reports = []
    changed = dataclasses.replace(SMALL, iterations=100000, minutes=0.5)
    trained = train.train([make()], tmp_path / "model.pt", changed, reports.append, clock=lambda: float(next(now)))
    assert trained["provenance"]["seconds"] == pytest.approx(30, abs=2)
    assert reports[-1].progress >= 1.0
    assert trained["provenance"]["iterations_done"] < 100


def test_learning_rate_is_one_cycle():
    progress = np.linspace(0, 1, 1001)
    rates = np.array([one_cycle(each, 0.003) for each in progress])
    assert rates[0] == pytest.approx(0.003 * 0.04)
    assert rates[-1] == pytest.approx(0.0, abs=1e-9)
    assert progress[rates.argmax()] == pytest.approx(0.3)
    assert rates.max() == pytest.approx(0.003)
    assert np.all(np.diff(rates[:301]) > 0)
    assert np.all(np.diff(rates[300:]) < 0)


def test_several_data_sets_of_one_robot_train_one_model(tmp_path):
    data = [make(), make(5, seed=1)]
    trained = train.train(data, tmp_path / "model.pt", SMALL)["provenance"]
    alone = [train.train([each], tmp_path / f"{i}.pt", SMALL)["provenance"] for i, each in enumerate(data)]
    assert trained["samples"] == 450
    assert trained["windows"] == list(np.sum([each["windows"] for each in alone], axis=0))
    assert len({trained["data_sha256"], *(each["data_sha256"] for each in alone)}) == 3
    assert [generation["seed"] for generation in trained["generation"]] == [0, 1]
    swapped = train.train(data[::-1], tmp_path / "swapped.pt", SMALL)["provenance"]
    assert swapped["data_sha256"] != trained["data_sha256"]


def test_data_of_a_simulated_and_of_a_real_robot_are_refused_together(tmp_path):
    real, imported = make(), make(seed=1)
    real.generation["source"], imported.generation["source"] = "robot", "import"
    with pytest.raises(
        ModelError, match="data of a simulated robot and of a real robot; a model is trained on data of"
    ):
        train.train([make(), real], tmp_path / "m.pt", SMALL)
    assert train.train([real, imported], tmp_path / "m.pt", SMALL)["provenance"]["samples"] == 600


def test_data_sets_of_different_robots_are_refused(tmp_path):
    other = make()
    other.generation["robot"]["limits"]["largest_actuation_step"] = 0.9
    with pytest.raises(ModelError, match=r"different robots, pneumatic-3 and pneumatic-3 \(or of one"):
        train.train([make(), other], tmp_path / "model.pt", SMALL)


def test_evenly_spread_windows_are_at_most_the_number_given():
    windows = dataset.Windows(np.arange(100, dtype=np.float32)[:, None, None], np.zeros((100, 1, 1), np.float32))
    assert len(windows.evenly(100)) == 100
    values = windows.evenly(30).features[:, 0, 0]
    assert len(values) == 25
    assert set(np.diff(values)) == {4.0}
