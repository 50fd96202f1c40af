"""The paper's training on several GPUs, on paper: work, memory, bytes between devices, hours and cost. Nothing is run.

    python benchmarks/scaling.py --models base large

Floating-point operations and gradients are counted on the meta device. Rates, bandwidths and prices are assumptions.
`--batch` is per device, as with 32 images on 8; what a device does is the same then on however many.
"""

import argparse

import torch

import costs
from nerfdiff.cli import load_config
from nerfdiff.model import build_on_meta, settings_of
from nerfdiff.training.memory import WEIGHTS_ADAM_EMA, training_memory

GPUS = {"A100 80 GB": (312e12, 2.0e12, 1.8, 235e9), "H100 80 GB": (989e12, 3.35e12, 2.5, 370e9)}
"""Dense bf16 operations per second, bytes per second of its memory, dollars an hour (a common rate of 2025), and what
NCCL's all-reduce moves per second between the 8 GPUs of a node (bus bandwidth over NVLink)."""
UPDATE = 36
"""Bytes per parameter that AdamW and the average read and write."""
NETWORKS = {"8 x 200 Gb/s": 160e9, "1 x 100 Gb/s": 11e9}
"""Bytes per second of an all-reduce between nodes, whose 8 GPUs share them."""


def all_reduce(gradients: int, devices: int, within: float, between: float) -> float:
    """Seconds of an all-reduce: a ring through all devices, as fast as its slowest link."""
    bus = within if devices <= 8 else min(within, between)
    return 2 * (devices - 1) / devices * gradients / bus


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=["base", "large"])
    parser.add_argument("--batch", type=int, default=4, help="images per device and step")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--steps", type=int, default=500_000)
    parser.add_argument("--rate", type=float, default=0.35, help="share of the bf16 rate that a step reaches")
    parser.add_argument("--memory", action="store_true", help="also trace a step's memory, which takes minutes")
    arguments = parser.parse_args()
    for name in arguments.models:
        config = settings_of(load_config("train", [f"model={name}", "data=srn_cars"]))
        config["unet"]["checkpointing"] = False
        parameters = list(build_on_meta(config).parameters())
        gradients = sum(p.numel() * p.element_size() for p in parameters if p.requires_grad)
        state = WEIGHTS_ADAM_EMA * sum(p.numel() for p in parameters)
        flops = costs.training(config, arguments.size, 1, 1, torch.bfloat16).flops * arguments.batch
        print(
            f"{name}: {state / WEIGHTS_ADAM_EMA / 1e6:.0f}M parameters, gradients {gradients / 1e9:.2f} GB, "
            f"{flops / 1e12:.1f} TFLOP per device and step of {arguments.batch}; weights, Adam and EMA "
            f"{state / 2**30:.1f} GiB, gradients twice (DDP's buckets) {2 * gradients / 2**30:.1f} GiB"
        )
        if arguments.memory:
            step = training_memory(config, arguments.batch, 1, arguments.size, arguments.size, "bf16-mixed").step
            print(f"  a step without recomputing: {step / 2**30:.1f} GiB beside")
        for gpu, (rate, memory, price, within) in GPUS.items():
            compute = flops / rate / arguments.rate + UPDATE * state / WEIGHTS_ADAM_EMA / memory
            for devices in (1, 8, 16, 64):
                for network, between in NETWORKS.items() if devices > 8 else [("", within)]:
                    sent = all_reduce(gradients, devices, within, between)
                    seconds = max(compute, sent) if devices > 1 else compute
                    slowest = compute + sent
                    hours = arguments.steps * seconds / 3600
                    print(
                        f"  {gpu} x {devices:<3}{network:13} batch {arguments.batch * devices:<4}"
                        f"compute {compute:.3f} s, all-reduce {sent:.3f} s: {seconds:.3f} to {slowest:.3f} s, "
                        f"{hours / 24:.1f} days, ${hours * devices * price:,.0f}"
                    )


if __name__ == "__main__":
    main()
