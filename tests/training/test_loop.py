import errno
import multiprocessing
import os
import socket
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from lib.landmarks.heatmaps import render
from lib.landmarks.network import HourglassConfig, OffsetConfig, OffsetNetwork, StackedHourglass, as_tensor
from lib.training import loop
from lib.training.augmentation import AUGMENTATIONS, Augmentation, Batch
from lib.training.loop import PRESETS, TrainingConfig, heatmap_loss, load_training, offset_loss, train
from lib.training.samples import Mixed, Samples
from tests.toys import toy_samples

SMALL = replace(
    PRESETS["best"],
    network=HourglassConfig(6, 1, 2),
    augmentation=Augmentation(20.0, (0.8, 1.2), photometric=0.5),
    steps=6,
    batch_size=2,
    validate_every=2,
)
TOGETHER = replace(
    PRESETS["best"], network=HourglassConfig(6, 1, 2), steps=12, batch_size=2, validate_every=4, precision="fp32",
    learning_rate=4e-3, augmentation=AUGMENTATIONS["none"],
)  # fmt: skip


@pytest.fixture(scope="module")
def whole(toy):
    """The training `SMALL` of six toys without a stop; treated as read-only."""
    return train(SMALL, toy(6), toy(2, seed=1), progress=False)


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))


def test_training_lowers_the_loss_and_finds_the_landmarks(trained):
    log = trained.log
    assert log[-1]["loss"] < 0.6 * log[0]["loss"]
    assert log[-1]["validation_loss"] < log[0]["validation_loss"]
    assert log[-1]["pck_0.10"] > max(30, log[0]["pck_0.10"])
    assert log[-1]["spread"] == pytest.approx(1, abs=0.3)


@pytest.mark.parametrize(
    "changes", [{}, {"optimiser": "rmsprop", "ema": 0.0, "schedule": "constant", "precision": "fp32"}]
)
def test_resume_is_exact(whole, toy, tmp_path, changes):
    """Killed in the middle of a step, after the checkpoint of step 4."""
    config = replace(SMALL, **changes)
    data, held_out = toy(6), toy(2, seed=1)
    if changes:
        whole = train(config, data, held_out, progress=False)

    class Killed(BaseException):
        pass

    class Source(Samples):
        drawn = 0

        def draw(self, index, rng):
            Source.drawn += 1
            if Source.drawn > 5 * config.batch_size:
                raise Killed
            return super().draw(index, rng)

    with pytest.raises(Killed):
        train(config, Source(data.images, data.u, data.visibility), held_out, tmp_path, progress=False)
    assert load_training(tmp_path / "last.safetensors").provenance["steps"] == 4
    resumed = train(config, data, held_out, tmp_path, progress=False)
    assert same(whole.network, resumed.network)
    assert [row["step"] for row in resumed.log] == [2, 4, 6]
    assert resumed.log[-1]["validation_loss"] == whole.log[-1]["validation_loss"]
    assert same(load_training(tmp_path / "last.safetensors").network, whole.network)


def test_another_seed_is_another_training(toy):
    a, b = (train(replace(SMALL, steps=2, seed=s), toy(8), toy(4), progress=False).network for s in (0, 1))
    assert not same(a, b)


def test_a_folder_of_another_training_or_data_is_refused(toy, tmp_path):
    config = replace(SMALL, steps=2)
    train(config, toy(8), toy(4), tmp_path, progress=False)
    with pytest.raises(ValueError, match="another learning_rate"):
        train(replace(config, learning_rate=1e-4), toy(8), toy(4), tmp_path, progress=False)
    with pytest.raises(ValueError, match="other data"):
        train(config, toy(9), toy(4), tmp_path, progress=False)


def test_disk_full_leaves_the_last_checkpoint(toy, tmp_path, monkeypatch):
    config = replace(SMALL, steps=4)
    path = tmp_path / "last.safetensors"
    train(replace(config, steps=4), toy(8), toy(4), tmp_path, progress=False, max_seconds=0.0)
    good = path.read_bytes()
    real = Path.write_bytes

    def full(self, data):
        real(self, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"last\.safetensors: not saved \(No space left.*unharmed"):
        train(config, toy(8), toy(4), tmp_path, progress=False)
    assert path.read_bytes() == good
    assert not list(tmp_path.glob("*.partial"))
    monkeypatch.undo()
    assert train(config, toy(8), toy(4), tmp_path, progress=False).log[-1]["step"] == 4


def test_paper_preset_is_as_printed():
    run = loop.Run(replace(PRESETS["paper"], network=HourglassConfig(8, 1, 3)))
    group = run.optimiser.param_groups[0]
    assert isinstance(run.optimiser, torch.optim.RMSprop)
    assert (group["alpha"], group["momentum"], group["lr"]) == (0.99, 0, 5e-5)
    paper = PRESETS["paper"].augmentation
    assert (paper.rotation_deg, paper.zoom, paper.photometric) == (30.0, (0.75, 1.25), 0)


def test_loss_of_empty_heatmaps_is_one_and_of_the_target_zero():
    u = torch.tensor([[[30.0, 30.0], [60.0, 50.0], [40.0, 64.0]]])
    batch = Batch(torch.zeros(1, 3, 96, 128), u, torch.full((1, 3), 2))
    target = render(u, (96, 128), 4)
    assert heatmap_loss([torch.zeros_like(target)], batch, 4).item() == pytest.approx(1, abs=0.01)
    assert heatmap_loss([target, target], batch, 4).item() == 0
    # Intermediate supervision: both stacks count alike.
    assert heatmap_loss([target, 0 * target], batch, 4) == heatmap_loss([0 * target, target], batch, 4)


def test_unlabelled_landmarks_have_no_loss():
    u = torch.tensor([[[30.0, 30.0], [60.0, 50.0], [torch.nan, torch.nan]]])
    batch = Batch(torch.zeros(1, 3, 96, 128), u, torch.full((1, 3), 2))
    output = render(u, (96, 128), 4)
    output[:, 2] = 5.0
    assert heatmap_loss([output], batch, 4) == 0


def test_a_mixed_source_draws_the_share_that_it_says(toy):
    dark, bright = toy(3, size=(64, 64)), toy(5, size=(64, 64))
    dark = Samples(np.zeros_like(dark.images), dark.u, dark.visibility)
    mixed, rng = Mixed(dark, replace(bright, images=np.full_like(bright.images, 255)), 0.75), np.random.default_rng(0)
    drawn = [mixed.draw(i % len(mixed), rng)[0].mean() for i in range(400)]
    assert len(mixed) == 8 and 0.7 < np.mean(np.array(drawn) == 0) < 0.8
    assert mixed.fingerprint != replace(mixed, share=0.5).fingerprint != replace(mixed, own=mixed.other).fingerprint


def test_bad_data_is_named(toy):
    good = toy(2)
    with pytest.raises(ValueError, match="empty data set"):
        Samples(good.images[:0], good.u[:0], good.visibility[:0])
    with pytest.raises(ValueError, match="all landmarks of all images are missing"):
        Samples(good.images, np.full_like(good.u, np.nan), good.visibility)
    with pytest.raises(ValueError, match="images: expected"):
        Samples(good.images[..., :1], good.u, good.visibility)
    with pytest.raises(ValueError, match="u and visibility"):
        Samples(good.images, good.u[:1], good.visibility)


def test_a_cosine_schedule_ends_with_the_time():
    config = TrainingConfig(steps=1000, learning_rate=1.0, schedule="cosine")
    assert config.rate(500, spent=0.2) == config.rate(500) > config.rate(500, spent=0.9) > config.rate(500, spent=5.0) > 0


@pytest.mark.parametrize("changes", [{"optimiser": "sgd"}, {"schedule": "step"}, {"precision": "fp8"}, {"steps": 0}])
def test_bad_configurations_are_named(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        TrainingConfig(**changes)


def one_of_two(rank: int, port: int, out: Path) -> None:
    """A process as torchrun starts it."""
    os.environ |= {"WORLD_SIZE": "2", "RANK": str(rank), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    done = train(TOGETHER, toy_samples(20), toy_samples(4, 1), out, progress=False)
    torch.save((done.network.state_dict(), done.log), out / f"rank{rank}.pt")


def test_two_processes_train_one_network(tmp_path, monkeypatch):
    """Two CPU processes: other batches, the same weights, a falling loss, one log."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    context = multiprocessing.get_context("fork")  # it imports nothing anew, and no GPU is seen there
    running = [context.Process(target=one_of_two, args=(rank, port, tmp_path)) for rank in (0, 1)]
    for process in running:
        process.start()
    for process in running:
        process.join(timeout=240)
    assert [process.exitcode for process in running] == [0, 0]
    (a, log), (b, _) = (torch.load(tmp_path / f"rank{rank}.pt") for rank in (0, 1))
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert log[-1]["loss"] < log[0]["loss"]
    alone = load_training(tmp_path / "last.safetensors")
    assert alone.provenance["processes"] == 2
    assert [row["step"] for row in alone.log] == [4, 8, 12]
    assert all(torch.equal(a[name], value) for name, value in alone.network.state_dict().items())
    with pytest.raises(ValueError, match=r"begun by 2 process\(es\), now 1; start as many"):
        train(TOGETHER, toy_samples(20), toy_samples(4, 1), tmp_path, progress=False)


def test_averaging_over_processes_is_a_batch_of_all(monkeypatch, toy):
    """The mean of the processes' gradients is the gradient of the joined batch (without batch statistics)."""
    network = StackedHourglass(HourglassConfig(6, 1, 2)).eval()
    for head in network.heads:
        torch.nn.init.normal_(head.weight, std=0.1)
    data = toy(4)
    batches = [loop.prepared(loop.draw_batch(data, c := replace(SMALL, seed=s), 0), c) for s in (0, 1)]

    def gradients(batch):
        network.zero_grad()
        heatmap_loss(network(batch.images), batch, network.stride).backward()
        return [p.grad.clone() for p in network.parameters() if p.grad is not None]

    joined = Batch(*(torch.cat([getattr(b, k) for b in batches]) for k in ("images", "u", "visibility")))
    mine, others = gradients(batches[0]), gradients(batches[1])
    monkeypatch.setattr(loop.dist, "all_reduce", lambda t: t.add_(torch.cat([g.flatten() for g in others])))
    loop.average(mine, 2)
    for a, b in zip(mine, gradients(joined), strict=True):
        assert torch.allclose(a, b, atol=1e-5 + 1e-3 * float(b.abs().max()))


def test_batches_drawn_ahead_are_the_same_and_in_order(toy):
    data = toy(6)

    def late(step):
        time.sleep(0.03 * (step % 2))  # the others overtake
        return loop.draw_batch(data, SMALL, step)

    for step, drawn in zip(range(3, 12), loop.batches(late, range(3, 12), threads=3), strict=True):
        one, other = loop.prepared(drawn, SMALL), loop.prepared(loop.draw_batch(data, SMALL, step), SMALL)
        assert all(torch.equal(getattr(one, k), getattr(other, k)) for k in ("images", "u", "visibility"))


def test_an_error_while_drawing_ahead_ends_the_training():
    def draw(step):
        if step == 4:
            raise ValueError("damaged")
        return (step,)

    drawn = loop.batches(draw, range(100), threads=2)
    assert [next(drawn) for _ in range(4)] == [(0,), (1,), (2,), (3,)]
    with pytest.raises(ValueError, match="damaged"):
        next(drawn)


def test_images_of_another_type_are_refused():
    drawn = np.zeros((1, 8, 8, 3), np.float32), np.zeros((1, 3, 2)), np.zeros((1, 3)), np.random.default_rng(0)
    with pytest.raises(ValueError, match="draws uint8, got float32"):
        loop.prepared(drawn, SMALL)


@pytest.mark.cuda
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_a_gpu_learns_what_a_cpu_does_and_resumes(gpu, monkeypatch, toy, tmp_path, precision):
    """But for rounding, which Adam's first steps make large, and noise, which a GPU draws by itself."""
    still = Augmentation(20.0, (0.8, 1.2))
    config = replace(SMALL, augmentation=still, steps=12, validate_every=4, precision=precision)
    data = toy(6), toy(2, seed=1)
    train(config, *data, tmp_path, progress=False, max_seconds=0)  # stops after a step
    on_gpu = train(config, *data, tmp_path, progress=False)
    assert next(on_gpu.network.parameters()).device.type == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    on_cpu = train(replace(config, precision="fp32"), *data, progress=False)
    gpu, cpu = ([row["loss"] for row in training.log] for training in (on_gpu, on_cpu))
    assert gpu[0] == pytest.approx(cpu[0], rel=0.05)
    assert gpu == pytest.approx(cpu, rel=0.2)


def test_a_checkpoint_older_than_an_option_resumes_by_its_default(toy, tmp_path):
    config = replace(SMALL, steps=4)
    train(replace(config), toy(6), toy(2), tmp_path, progress=False, max_seconds=0)
    path = tmp_path / "last.safetensors"
    tensors, metadata = loop.read_checkpoint(path, loop.FORMAT)
    assert metadata["step"] < 4
    del metadata["config"]["sigma_px"], metadata["config"]["augmentation"]["photometric_share"]
    metadata["config"]["gone"] = 0.0  # an option of an earlier version, which was off
    loop.write_checkpoint(path, tensors, metadata)
    with pytest.raises(ValueError, match="another sigma_px"):
        train(replace(config, sigma_px=4.0), toy(6), toy(2), tmp_path, progress=False)
    assert train(config, toy(6), toy(2), tmp_path, progress=False).provenance["steps"] == 4
    metadata["config"]["magic"] = 1
    loop.write_checkpoint(path, tensors, metadata)
    with pytest.raises(ValueError, match="another magic"):
        train(config, toy(6), toy(2), tmp_path, progress=False)


def test_a_stop_at_any_step_changes_nothing(whole, toy, tmp_path):
    """Neither the weights nor the log."""
    data, held_out = toy(6), toy(2, seed=1)
    steps = []
    while not steps or steps[-1] < SMALL.steps:
        part = train(SMALL, data, held_out, tmp_path, progress=False, max_seconds=0.0)  # one step a sitting
        steps.append(part.log[-1]["step"])
    assert steps == [1, 2, 3, 4, 5, 6]
    assert same(part.network, whole.network)
    for row, other in zip(part.log, whole.log, strict=True):
        assert {**row, "seconds": 0} == {**other, "seconds": 0}


def test_a_fine_tuning_remembers_where_it_began(whole, toy, tmp_path):
    data, held_out = toy(6), toy(2, seed=1)
    first, second = whole, train(replace(SMALL, seed=1), data, held_out, progress=False)
    train(SMALL, data, held_out, tmp_path, initial=first, max_seconds=0.0, progress=False)
    with pytest.raises(ValueError, match=r"last\.safetensors: was begun from other weights"):
        train(SMALL, data, held_out, tmp_path, initial=second, progress=False)
    resumed = train(SMALL, data, held_out, tmp_path, progress=False)
    assert resumed.provenance["steps"] == SMALL.steps
    for provenance in (resumed.provenance, load_training(tmp_path / "last.safetensors").provenance):
        assert provenance["before"]["data"] == first.provenance["data"]
        assert provenance["before"]["steps"] == SMALL.steps


def test_fine_tuning_starts_from_the_same_network_or_says_so(whole, toy):
    first = whole
    still = replace(SMALL, steps=1, learning_rate=1e-12)
    again = train(still, toy(6), toy(2, seed=1), initial=first, progress=False)
    for one, other in zip(again.network.parameters(), first.network.parameters(), strict=True):
        assert torch.allclose(one, other, atol=1e-9)
    assert again.provenance["before"] == first.provenance
    wider = replace(SMALL, network=replace(SMALL.network, features=2 * SMALL.network.features))
    with pytest.raises(ValueError, match="initial: is a network"):
        train(wider, toy(6), toy(2, seed=1), initial=first, progress=False)


def closeups(n, seed):
    """A bright dot near the middle of each, with the role of one landmark."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:32, :32]
    u, visibility = np.full((n, 3, 2), 5.0), np.zeros((n, 3), int)
    which = rng.integers(3, size=n)
    own = 15.5 + rng.uniform(-5, 5, (n, 2))
    u[np.arange(n), which], visibility[np.arange(n), which] = own, 2
    dots = 200 * np.exp(-((columns - own[:, 0, None, None]) ** 2 + (rows - own[:, 1, None, None]) ** 2) / 12)
    return Samples(np.repeat((dots + rng.uniform(0, 30, dots.shape))[..., None], 3, 3).astype(np.uint8), u, visibility)


def test_offset_loss_is_the_laplace_likelihood_of_the_own_landmark():
    u = torch.tensor([[[20.0, 20.0], [18.5, 11.5], [0.0, 0.0]], [[15.5, 15.5]] * 3])
    batch = Batch(torch.zeros(2, 3, 32, 32), u, torch.tensor([[0, 2, 0], [0, 1, 0]]))  # the second shows none
    found = torch.tensor([[3.0, 0.0, 0.0, np.log(2.0)], [9.0, 9.0, 9.0, 9.0]], requires_grad=True)
    loss = offset_loss([found], batch)
    assert loss.item() == pytest.approx(0.1 + np.log(2.0) + np.hypot(4.0, 0.1) / 2)
    loss.backward()
    assert found.grad[1].abs().max() == 0
    assert found.grad[0, 3].item() == pytest.approx(1 - np.hypot(4.0, 0.1) / 2)
    absent = Batch(batch.images[1:], u[1:], batch.visibility[1:])
    assert offset_loss([found[1:]], absent).item() == 0.0
    unlabelled = Batch(batch.images[:1], torch.full_like(batch.u[:1], torch.nan), batch.visibility[:1])
    assert offset_loss([found[:1]], unlabelled).item() == 0.0


def test_an_offset_network_learns_where_a_dot_is_and_how_well_it_knows(tmp_path):
    config = replace(
        PRESETS["best"], network=OffsetConfig(6, 32), augmentation=Augmentation(0.0, (1.0, 1.0)), steps=60, batch_size=32,
        ema=0.9, learning_rate=1e-2, validate_every=30, precision="fp32",
    )  # fmt: skip
    source, unseen = closeups(400, 0), closeups(60, 1)
    trained = train(config, source, unseen, tmp_path / "whole", progress=False)
    first, last = trained.log[0], trained.log[-1]
    assert last["validation_loss"] < first["validation_loss"]
    assert last["median_px"] < 1.0
    assert "peak" not in last
    loaded = load_training(tmp_path / "whole" / "last.safetensors").network
    assert isinstance(loaded, OffsetNetwork)
    assert same(loaded, trained.network)
    # Interrupted and resumed it is the same network.
    short = replace(config, steps=6)
    half = train(short, source, unseen, tmp_path / "parts", max_seconds=0.0, progress=False)
    assert half.provenance["steps"] < 6
    resumed = train(short, source, unseen, tmp_path / "parts", progress=False)
    assert same(resumed.network, train(short, source, unseen, progress=False).network)


def test_the_fused_optimiser_takes_the_steps_of_the_plain_one(monkeypatch):
    """It ignores the order of a tensor in memory, which differs between weights and what a checkpoint restores."""
    some = toy_samples(4)
    batch = Batch(as_tensor(some.images), torch.from_numpy(some.u).float(), torch.from_numpy(some.visibility))
    runs = [loop.Run(TOGETHER)]
    monkeypatch.setitem(loop._OPTIMISERS, "adamw", partial(torch.optim.AdamW, weight_decay=1e-4))
    runs.append(loop.Run(TOGETHER))
    for _ in range(3):
        for run in runs:
            run.advance(batch)
    fused, plain = (torch.cat([p.flatten() for p in run.network.parameters()]) for run in runs)
    assert torch.allclose(fused, plain, atol=1e-4)
