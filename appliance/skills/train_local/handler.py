"""train_local: one federated round on a client's own data. Its update is what training changed, as safetensors shards.

The arguments are in `_lib.learning.orders`. A run that is moved or tried again goes on from its last checkpoint: model
and optimiser lie in artifacts, and the samples of each step follow from the seed, so it comes to the same update.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from _lib.context import Context, Surroundings
from _lib.learning import orders, shards, training, work
from _lib.learning.decoders import CorruptFileError
from _lib.learning.masks import Seed, masked, read_seeds
from _lib.learning.models import Tensor
from _lib.learning.orders import OrderError
from _lib.learning.training import AfterStep, Outcome, Plan, Samples, State

MOST_SCALED = 10.0
"""As of `learn.rounds`: an update of less than a tenth of its epoch is enlarged no further where it is summed."""
NEWS_S = 0.5
"""How often progress is published."""


def preload(ctx: Surroundings) -> None:
    """Make one training step of each model: what PyTorch loads on the way is then shared by all runs."""
    del ctx
    training.warm_up()


def run(ctx: Context) -> dict[str, Any]:
    """Return the update (shards, manifest), samples, steps, steps_of_epoch, loss, train_s, first_step_s, classes.

    Of an update in 8 bits (`coding`) also the files of what coding left over (`residual`), for the client's next one.
    With `secure` the update is masked, and no checkpoint is kept.
    """
    began = time.monotonic()
    try:
        order = orders.training(ctx.params, robot=ctx.robot)
    except OrderError as error:
        raise work.refused(ctx, error) from error
    training.set_threads()
    model = work.model_of(ctx, order.model)
    held = work.share(ctx, model, order.data, order.part, run_seed=order.seed)
    tensors = model.tensors(len(held.classes))
    base = work.base_values(ctx, order.base, tensors, order.seed)
    # Before anything is trained: a client without masks takes no part.
    seeds = read_seeds(ctx.request("masks", epoch=order.secure)["masks"]) if order.secure else ()
    try:
        module = training.build(model, len(held.classes))
    except ValueError as error:
        raise ctx.Fail(str(error), "write model.toml and model.py alike") from error
    training.put(module, base)
    plan = Plan(
        task=model.task,
        optimiser=order.optimiser or orders.optimiser_of(model.optimiser),
        epochs=order.epochs,
        batch=order.batch or model.batch,
        run_seed=order.seed,
        round=order.round,
        client=order.client,
        stop_at=None if order.stop_at_s is None else began + order.stop_at_s,
        speed=order.speed,
        nominal_batch_s=order.nominal_batch_s,
        most_steps=order.most_steps,
    )
    samples = Samples(held.arrays, held.targets)
    try:
        done = training.train(
            module,
            samples,
            plan,
            resume=_resume(ctx, order),
            alive=ctx.alive,
            after_step=_follow(ctx, order, min(plan.batch, len(held.arrays))),
        )
    except CorruptFileError as error:
        raise ctx.Fail(f"a file was damaged during training: {error}", "copy the data again", retryable=True) from error
    delta = {name: done.values[name] - base[name] for name in base}
    try:
        update = _keep_masked(ctx, order, delta, held, seeds) if seeds else _keep(ctx, order, delta, tensors, done)
    except work.ModelFileError as error:
        raise ctx.Fail(f"training diverged: {error}", "take a lower learning rate") from error
    return _result(done, update, held, began) | _notes(module, done)


def _result(done: Outcome, update: dict[str, Any], held: work.Share, began: float) -> dict[str, Any]:
    return {
        "update": {key: value for key, value in update.items() if key != "residual"},
        **update,
        "samples": len(held.arrays),
        "damaged": held.damaged,
        "classes": list(held.classes),
        "steps": done.steps,
        "steps_of_epoch": done.steps_of_epoch,
        "loss": done.loss,
        "train_s": round(done.seconds, 4),
        "first_step_s": round(done.first_step_at - began, 4),
        "late_batches": done.late_batches,
    }


def _keep(
    ctx: Context, order: orders.Training, delta: dict[str, work.Floats], tensors: Sequence[Tensor], done: Outcome
) -> dict[str, Any]:
    """Keep the update as artifacts, in 8 bits where that is asked for; returns its references."""
    name = f"update-{order.round}"
    if order.compression == "none":
        manifest, references = work.keep(ctx, delta, name)
        return {"manifest": manifest, "shards": references}
    whole = done.steps_of_epoch * order.epochs
    scale = min(MOST_SCALED, max(1.0, whole / done.steps))
    coded = work.keep_coded(ctx, delta, work.residual(ctx, order.residual, tensors), name, scale=scale)
    return {"manifest": coded.manifest, "shards": coded.shards, "coding": "int8", "residual": coded.residual}


def _keep_masked(
    ctx: Context, order: orders.Training, delta: dict[str, work.Floats], held: work.Share, seeds: Sequence[Seed]
) -> dict[str, Any]:
    """Keep the update as artifacts with its masks on; without them it never leaves this process."""
    norm = shards.squared_norm(delta[each] for each in sorted(delta)) ** 0.5
    if order.clip is not None and norm > order.clip:
        delta = {name: array * np.float32(order.clip / norm) for name, array in delta.items()}
    values = masked(delta, len(held.arrays) if order.clip is None else 1, seeds)
    manifest, references = work.keep(ctx, values, f"update-{order.round}", masked=True)
    return {"manifest": manifest, "shards": references, "coding": "masked"}


def _notes(module: Any, done: Outcome) -> dict[str, Any]:
    notes: list[str] = []
    if kept := training.running_statistics(module):
        notes.append(f"running statistics stay with each client: {', '.join(kept[:5])}; GroupNorm keeps none")
    if done.late_batches:
        notes.append(f"{done.late_batches} batches took over 1.1 times what the emulated device is given")
    return {"note": "; ".join(notes)} if notes else {}


def _resume(ctx: Context, order: orders.Training) -> State | None:
    """Return where an earlier attempt of the same round stood, if it kept that."""
    kept = ctx.resume
    if order.secure or kept is None or kept.get("base") != _base_key(order):
        return None
    try:
        manifest = work.manifest_of(ctx, kept["manifest"])
        references = kept["shards"]
        work.check_count(manifest, references)
        files = [work.fetch_shard(ctx, manifest, references, number) for number in range(len(references))]
        values = work.shards.join(manifest, files)
    except work.ModelFileError as error:
        ctx.log(f"the checkpoint is not used: {error}")
        return None
    return State(int(kept["step"]), float(kept["loss_sum"]), values)


def _base_key(order: orders.Training) -> str:
    """Return what a checkpoint belongs to: the model that the round began with."""
    first = order.base.shards[0]["artifact"] if order.base is not None else "initial"
    return f"{order.run}/{order.round}/{first}"


def _follow(ctx: Context, order: orders.Training, batch: int) -> AfterStep:
    """Return what tells progress, and keeps checkpoints when they are due."""
    began = last_told = time.monotonic()
    first: int | None = None

    def after_step(step: int, total: int, loss_sum: float, values: Callable[[], dict[str, work.Floats]]) -> None:
        nonlocal last_told, first
        now = time.monotonic()
        first = step - 1 if first is None else first
        if now - last_told > NEWS_S or step == total:
            last_told = now
            rate = (step - first) * batch / max(1e-6, now - began)
            ctx.progress(step / total, f"step {step}/{total}, loss {loss_sum / step:.3f}, {rate:.0f} samples/s")
        if order.secure:  # a checkpoint would be the update without its masks
            return
        if step < total and (ctx.checkpoint_due() or (order.every_steps and step % order.every_steps == 0)):
            manifest, references = work.keep(ctx, values(), f"checkpoint-{order.round}-{step}")
            kept = {"step": step, "loss_sum": loss_sum, "manifest": manifest, "shards": references}
            ctx.checkpoint({"base": _base_key(order), **kept})

    return after_step
