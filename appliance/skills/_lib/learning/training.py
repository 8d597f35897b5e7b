# pyright: basic, reportMissingImports=false
# PyTorch is in image `learn` only.
"""Trains and judges a model on arrays: plain loops on one thread, the same on PyTorch 1.13 and 2.

One thread, set before the first operation: a container's zygote is forked for each run, and a child that uses more
threads than its parent did waits for ever for one that was not forked with it. The first backward pass loads much that
all runs can share, so `warm_up` makes whole training steps in the zygote.

No `torch.load`: what comes from elsewhere is read by `shards`.
"""

import importlib.util
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from .models import Model, read
from .orders import Optimiser
from .seeds import seed as derive

Floats = NDArray[np.float32]
Network = Any
"""A `torch.nn.Module`; handlers are checked where there is no PyTorch."""
BLANK = 0
"""CTC's blank among the symbols."""
STRIDE = 2
"""Frames of a spectrogram for one of the output of a model that transcribes."""
SLICE_S = 0.2
"""Longest pause between signs of life while a slow device is emulated."""


AfterStep = Callable[[int, int, float, Callable[[], dict[str, Floats]]], None]


class Samples(NamedTuple):
    """What is learned from: arrays, and the class of each, or the symbols said."""

    arrays: Sequence[NDArray[Any]]
    targets: Sequence[Any]


class State(NamedTuple):
    """Where training stands after a step, all that going on needs."""

    step: int
    loss_sum: float
    values: dict[str, Floats]


class Outcome(NamedTuple):
    """What training has done. Steps are counted from its beginning, in whichever attempt they were made."""

    values: dict[str, Floats]
    steps: int
    steps_of_epoch: int
    loss: float
    seconds: float
    first_step_at: float
    late_batches: int
    """Batches that took over 1.1 times what the emulated device is given: the emulation does not hold."""


class Plan(NamedTuple):
    """How to train. `run_seed`, `round` and `client` are what orders of samples are drawn from."""

    task: str
    optimiser: Optimiser
    epochs: int
    batch: int
    run_seed: int
    round: int
    client: str
    stop_at: float | None
    """Monotonic time after which no step begins."""
    speed: float
    nominal_batch_s: float | None
    most_steps: int | None = None
    """Steps after which it ends, however much time is left: partial work that is made again exactly."""


def set_threads() -> None:
    """Have PyTorch use one thread. Before its first operation, or it raises nothing and later hangs."""
    torch.set_num_threads(1)
    if torch.get_num_interop_threads() != 1:
        torch.set_num_interop_threads(1)


def build(model: Model, classes: int) -> Network:
    """Return a model's network; ValueError where its tensors are not those of its `model.toml`."""
    module = _code(model).build(classes)
    found = {name: tuple(each.shape) for name, each in module.named_parameters()}
    listed = {tensor.name: tensor.shape for tensor in model.tensors(classes)}
    if found != listed:
        wrong = sorted(name for name in found.keys() | listed.keys() if found.get(name) != listed.get(name))
        raise ValueError(f"{model.folder / 'model.toml'} does not list the tensors of model.py: {', '.join(wrong[:5])}")
    return module


def _code(model: Model) -> ModuleType:
    name = f"swiftbot_model_{model.name}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, model.folder / "model.py")
    if spec is None or spec.loader is None:
        raise ValueError(f"{model.folder / 'model.py'} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def put(module: Network, values: Mapping[str, NDArray[Any]]) -> None:
    """Set a network's parameters."""
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            parameter.copy_(torch.from_numpy(np.array(values[name], dtype=np.float32)))


def get(module: Network) -> dict[str, Floats]:
    """Return a copy of a network's parameters by name."""
    return {name: each.detach().numpy().copy() for name, each in module.named_parameters()}


def running_statistics(module: Network) -> tuple[str, ...]:
    """Return the buffers that a network keeps beside its parameters: they stay with each client."""
    return tuple(name for name, _ in module.named_buffers())


def _inputs(arrays: Sequence[NDArray[Any]], task: str) -> torch.Tensor:
    """Return a batch: (n, 1, …) of float32; recordings of sentences are padded to the longest."""
    if task == "transcribe":
        longest = max(len(each) for each in arrays)
        padded = np.zeros((len(arrays), longest, arrays[0].shape[1]), dtype=np.float32)
        for row, each in zip(padded, arrays, strict=True):
            row[: len(each)] = each
        return torch.from_numpy(padded)
    stacked = np.stack(arrays)
    return torch.from_numpy(moving(stacked) if stacked.dtype == np.uint8 else stacked.astype(np.float32)).unsqueeze(1)


STILL = 0.3
"""Weight of the static part of a clip against its motion."""


def moving(clips: NDArray[np.uint8]) -> Floats:
    """Return clips, (n, pictures, height, width), with what moves brought out, each to the same contrast.

    A clip's mean picture is taken out, and put back with `STILL` of its contrast: otherwise a network first learns the
    places, which other clients do not have, and needs five times as many epochs.
    """
    values = clips.astype(np.float32)
    mean = values.mean(axis=1, keepdims=True)
    within = (1, 2, 3)
    moved = values - mean
    still = mean - mean.mean(axis=within, keepdims=True)
    return moved / (moved.std(axis=within, keepdims=True) + 1.0) + STILL * still / (
        still.std(axis=within, keepdims=True) + 1.0
    )


def _loss(
    module: Network, arrays: Sequence[NDArray[Any]], targets: Sequence[Any], task: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the mean loss of a batch, and what the network said."""
    said = module(_inputs(arrays, task))
    if task != "transcribe":
        return torch.nn.functional.cross_entropy(said, torch.tensor(list(targets), dtype=torch.long)), said
    lengths = torch.tensor([-(-len(each) // STRIDE) for each in arrays], dtype=torch.long)
    counts = torch.tensor([len(each) for each in targets], dtype=torch.long)
    flat = torch.tensor([symbol for each in targets for symbol in each], dtype=torch.long)
    return torch.nn.functional.ctc_loss(said, flat, lengths, counts, blank=BLANK, zero_infinity=True), said


def _optimiser(module: Network, wanted: Optimiser) -> torch.optim.Optimizer:
    if wanted.name == "adam":
        return torch.optim.Adam(module.parameters(), lr=wanted.lr)
    return torch.optim.SGD(module.parameters(), lr=wanted.lr, momentum=wanted.momentum)


_MEMORY = {"momentum_buffer": "m", "exp_avg": "m", "exp_avg_sq": "v"}
"""What optimisers keep of each parameter, and how it is named in a state."""


def _remember(module: Network, optimiser: torch.optim.Optimizer) -> dict[str, Floats]:
    """Return parameters (`p.NAME`) and what the optimiser keeps of them (`m.NAME`, `v.NAME`)."""
    values: dict[str, Floats] = {}
    for name, parameter in module.named_parameters():
        values[f"p.{name}"] = parameter.detach().numpy().copy()
        for key, kept in optimiser.state.get(parameter, {}).items():
            if key in _MEMORY and kept is not None:
                values[f"{_MEMORY[key]}.{name}"] = kept.detach().numpy().copy()
    return values


def _recall(module: Network, optimiser: torch.optim.Optimizer, state: State, wanted: Optimiser) -> None:
    put(module, {name[2:]: each for name, each in state.values.items() if name.startswith("p.")})
    for name, parameter in module.named_parameters():
        kept = {short: state.values.get(f"{short}.{name}") for short in ("m", "v")}
        if kept["m"] is None:
            continue
        moment = torch.from_numpy(kept["m"].copy())
        if wanted.name == "adam" and kept["v"] is not None:
            optimiser.state[parameter] = {
                "step": torch.tensor(float(state.step)),
                "exp_avg": moment,
                "exp_avg_sq": torch.from_numpy(kept["v"].copy()),
            }
        else:
            optimiser.state[parameter] = {"momentum_buffer": moment}


def train(
    module: Network,
    samples: Samples,
    plan: Plan,
    *,
    resume: State | None = None,
    after_step: AfterStep = lambda *_: None,
    alive: Callable[[], None] = lambda: None,
) -> Outcome:
    """Train and return what came of it.

    Args:
        module: network with the values to begin with, unless `resume` has others.
        samples: what is learned from; at least one.
        plan: how.
        resume: where an earlier attempt stood: the same samples, plan and seed give the same steps.
        after_step: told steps done, steps in all, the sum of losses, and what gives the values of a `State`.
        alive: called now and then while a slow device is emulated.
    """
    count = len(samples.arrays)
    steps_of_epoch = -(-count // plan.batch)
    total = steps_of_epoch * plan.epochs
    optimiser = _optimiser(module, plan.optimiser)
    step, loss_sum = 0, 0.0
    if resume is not None:
        _recall(module, optimiser, resume, plan.optimiser)
        step, loss_sum = resume.step, resume.loss_sum
    module.train()
    began = time.monotonic()
    first_step_at, late = 0.0, 0
    order: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
    epoch = -1
    # At least one step: an update of nothing is refused.
    last = total if plan.most_steps is None else min(total, plan.most_steps)
    while step < last and (step == 0 or plan.stop_at is None or time.monotonic() < plan.stop_at):
        if step // steps_of_epoch != epoch:
            epoch = step // steps_of_epoch
            order = shuffled(count, plan, epoch)
        batch_began = time.monotonic()
        at = step % steps_of_epoch * plan.batch
        chosen = order[at : at + plan.batch]
        # Not `torch.manual_seed`, which formats a traceback for GPUs each time.
        torch.default_generator.manual_seed(derive(plan.run_seed, plan.round, plan.client, f"step{step}"))
        optimiser.zero_grad()
        loss, _ = _loss(
            module, [samples.arrays[index] for index in chosen], [samples.targets[index] for index in chosen], plan.task
        )
        loss.backward()
        optimiser.step()
        loss_sum += float(loss.detach())
        step += 1
        first_step_at = first_step_at or time.monotonic()
        late += emulate(plan, batch_began, alive)
        after_step(step, total, loss_sum, lambda: _remember(module, optimiser))
    return Outcome(
        values=get(module),
        steps=step,
        steps_of_epoch=steps_of_epoch,
        loss=loss_sum / max(1, step),
        seconds=time.monotonic() - began,
        first_step_at=first_step_at,
        late_batches=late,
    )


def shuffled(count: int, plan: Plan, epoch: int) -> NDArray[np.int64]:
    """Return the order of samples of an epoch, the same wherever it is computed."""
    return np.random.Generator(
        np.random.Philox(derive(plan.run_seed, plan.round, plan.client, f"shuffle{epoch}"))
    ).permutation(count)


def emulate(plan: Plan, batch_began: float, alive: Callable[[], None]) -> int:
    """Wait until a device of the plan's speed would have done the batch; returns 1 where it took 10 % longer already.

    The wait ends early where the plan is to stop before. Without a nominal time a batch's own time is multiplied.
    """
    took = time.monotonic() - batch_began
    if plan.nominal_batch_s is None and plan.speed <= 1.0:
        return 0
    wanted = plan.speed * (took if plan.nominal_batch_s is None else plan.nominal_batch_s)
    until = batch_began + wanted
    if plan.stop_at is not None:
        until = min(until, plan.stop_at)
    while (left := until - time.monotonic()) > 0:
        time.sleep(min(left, SLICE_S))
        alive()
    return int(took > 1.1 * wanted)


class Verdict(NamedTuple):
    """How good a model is. `right` of `total`: items, or words less the errors made in them."""

    right: int
    total: int
    loss: float
    items: int


def judge(
    module: Network,
    samples: Samples,
    task: str,
    *,
    batch: int = 64,
    symbols: Sequence[str] = (),
    alive: Callable[[int], None] = lambda _: None,
) -> Verdict:
    """Return how a network does on samples; `symbols` are those of a model that transcribes."""
    module.eval()
    right = total = 0
    loss_sum = 0.0
    count = len(samples.arrays)
    with torch.no_grad():
        for at in range(0, count, batch):
            targets: Any
            arrays, targets = samples.arrays[at : at + batch], samples.targets[at : at + batch]
            loss, said = _loss(module, arrays, targets, task)
            loss_sum += float(loss) * len(arrays)
            if task == "transcribe":
                for column, (array, target) in enumerate(zip(arrays, targets, strict=True)):
                    heard = greedy(said[: -(-len(array) // STRIDE), column].numpy(), symbols).split()
                    meant = "".join(str(symbols[symbol]) for symbol in target).split()
                    right += len(meant) - min(len(meant), word_errors(heard, meant))
                    total += len(meant)
            else:
                right += int((said.argmax(dim=1).numpy() == np.array(list(targets))).sum())
                total += len(arrays)
            alive(at + len(arrays))
    return Verdict(right, total, loss_sum / max(1, count), count)


def features(module: Network, clip: NDArray[np.uint8]) -> list[float]:
    """Return what a network for clips makes of one, (16, 40, 40), before its last layer."""
    module.eval()
    with torch.no_grad():
        found = module.features(_inputs([clip], "classify"))
    return [float(each) for each in found[0].numpy()]


def transcribe(module: Network, spectrum: NDArray[np.float32], symbols: Sequence[str]) -> str:
    """Return the text that a network for sentences reads from a spectrogram, (frames, 40)."""
    if not len(spectrum):
        return ""
    module.eval()
    with torch.no_grad():
        said = module(_inputs([spectrum], "transcribe"))
    return greedy(said[:, 0].numpy(), symbols)


def greedy(scores: NDArray[Any], symbols: Sequence[str]) -> str:
    """Return the text of CTC output (frames, symbols): the best symbol of each frame, repeats and blanks left out."""
    best = scores.argmax(axis=1)
    kept = [int(each) for number, each in enumerate(best) if number == 0 or each != best[number - 1]]
    return " ".join("".join(symbols[each] for each in kept if each != BLANK).split())


def word_errors(heard: Sequence[str], meant: Sequence[str]) -> int:
    """Return the least insertions, deletions and replacements of words that make one of the other."""
    row = list(range(len(meant) + 1))
    for number, word in enumerate(heard, start=1):
        before, row[0] = row[0], number
        for place, other in enumerate(meant, start=1):
            before, row[place] = row[place], min(row[place] + 1, row[place - 1] + 1, before + (word != other))
    return row[-1]


def warm_up() -> None:
    """Make one whole training step of each shipped model, so that what it loads is loaded before the first fork."""
    set_threads()
    for name, shape in (("clips", (16, 40, 40)), ("words", (98, 40)), ("sentences", (40, 40))):
        model = read(name)
        count = len(model.classes)
        module = build(model, count)
        targets: Any = [(1, 2), (3,)] if model.task == "transcribe" else [0, 1]
        samples = Samples([np.zeros(shape, dtype=np.float32)] * 2, targets)
        for wanted in (Optimiser("sgd", 0.01, 0.9), Optimiser("adam", 0.001, 0.0)):
            train(module, samples, Plan(model.task, wanted, 1, 2, 0, 0, "", None, 1.0, None))
        judge(module, samples, model.task, symbols=model.classes)
