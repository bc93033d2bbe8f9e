#!/usr/bin/env python3
"""The training step of the restorer mini beside the same step in PyTorch, on one core.

    bench/train_mini_peer.py --train build/train_mini --data DIR --scenes A-B --check C --out DIR [--steps 40] [--runs 5]

DIR has the files of the scenes (train_mini --make-only). Both train the network of train_mini with batches of 8 crops of
96 x 96 with 3 references: forward, loss, backward, clipping, AdamW and moving average, all in f32. train_mini also makes its
batches in that time. The step of train_mini is the difference of the CPU times of runs with 1.5 and 0.5 times --steps, that of
PyTorch the CPU time of --steps steps; both take turns, and the fastest of --runs counts. PyTorch is run with both memory
formats, channels first and last. That both networks are the same is shown by the PSNR of the check scene, which PyTorch
computes from the weights that train_mini wrote. Needs numpy and torch (its CPU build is enough).
"""
import argparse
import json
import os
import resource
import struct
import subprocess
import sys
import time

import numpy as np
import torch
import torch.nn.functional as F

FRAME, REFERENCE, REFERENCES = 5, 14, 3
KEPT = np.log(0.012)


def tensors_of(path):
    data = open(path, "rb").read()
    size = struct.unpack("<Q", data[:8])[0]
    out = {}
    for name, t in json.loads(data[8:8 + size]).items():
        if name == "__metadata__":
            continue
        raw = data[8 + size + t["data_offsets"][0]:8 + size + t["data_offsets"][1]]
        if t["dtype"] == "U8":
            out[name] = np.frombuffer(raw, np.uint8).reshape(t["shape"])
        elif t["dtype"] == "BF16":
            out[name] = (np.frombuffer(raw, np.uint16).astype(np.uint32) << 16).view(np.float32).reshape(t["shape"])
        else:
            out[name] = np.frombuffer(raw, np.float32).reshape(t["shape"])
    return out


class Mini:
    def __init__(self, path, last):
        self.memory = torch.channels_last if last else torch.contiguous_format
        self.p = {}
        for name, value in tensors_of(path).items():
            t = torch.from_numpy(value.copy())
            self.p[name] = (t.to(memory_format=self.memory) if t.dim() == 4 else t).requires_grad_()
        self.average = {name: t.detach().clone() for name, t in self.p.items()}

    def conv(self, name, x, stride=1):
        weight = self.p[name + ".weight"]
        size = weight.shape[2]
        if stride == 2:  # no padding above and to the left
            x = F.pad(x, (0, 1, 0, 1))
        return F.conv2d(x, weight, self.p.get(name + ".bias"), stride, 0 if stride == 2 else size // 2)

    def block(self, name, x):
        return x + self.conv(name + ".second", F.relu(self.conv(name + ".first", F.relu(x))))

    def forward(self, frame, shown):  # (B,5,H,W), (B,K,14,H,W)
        count = shown.shape[1]
        render = frame[:, None, :3]
        seen, valid = (shown[:, :, 6:7] > 0).float(), (shown[:, :, 12:13] > 0).float()
        photo, residual = seen * (shown[:, :, :3] - render), seen * shown[:, :, 3:6]
        back = valid * (shown[:, :, 9:12] - render)
        planes = torch.cat([2 * photo, 4 * residual, shown[:, :, 6:7], seen * shown[:, :, 7:9], 2 * back, valid,
                            valid * shown[:, :, 13:14]], 2)
        planes = self.unshuffle(planes.flatten(0, 1)).to(memory_format=self.memory)
        e = F.relu(self.conv("reference.second", F.relu(self.conv("reference.first", planes))))
        some = F.max_pool2d(torch.maximum(seen, valid).flatten(0, 1), 2)
        e = e * some
        share = (self.conv("reference.attention", e) - 1e30 * (1 - some)).unflatten(0, (-1, count))
        share = torch.softmax(torch.cat([share, torch.zeros_like(share[:, :1])], 1), 1)[:, :count]
        each = e.unflatten(0, (-1, count))
        start = self.unshuffle(torch.cat([frame[:, :3] - 0.5, frame[:, 3:]], 1))
        x = torch.cat([start, 2 * (share * each).sum(1), each.amax(1)], 1).to(memory_format=self.memory)
        down = []
        for level in range(4):
            x = self.conv("levels.%d.down" % level, x, 1 + (level > 0))
            for k in range(2 if "levels.%d.in.1.first.weight" % level in self.p else 1):
                x = self.block("levels.%d.in.%d" % (level, k), x)
            x = F.relu(x)
            down.append(x)
        for level in (2, 1, 0):
            small = self.conv("levels.%d.below" % level, x)
            x = self.conv("levels.%d.skip" % level, down[level]) + F.interpolate(small, scale_factor=2, mode="nearest")
            x = F.relu(self.block("levels.%d.out" % level, x))
        head = self.shuffle(self.conv("head", x))
        common = self.conv("head_frame", x)
        hidden = self.conv("head_reference", e).unflatten(0, (-1, count)) + common[:, None]
        choices = self.shuffle(self.conv("head_blend", F.relu(hidden.flatten(0, 1)))).unflatten(0, (-1, count))
        choices = choices - 1e30 * (1 - torch.cat([seen, seen, valid], 2))
        weight = torch.softmax(torch.cat([head[:, :2], choices.flatten(1, 2)], 1), 1)
        change = torch.cat([0.5 * head[:, None, 2:5], torch.stack([photo, residual, back], 2).flatten(1, 2)], 1)
        gate = ((head[:, 6:7] - KEPT) / np.log(2.0)).clamp(0, 1)
        out = frame[:, :3] + gate * (weight[:, 1:, None] * change).sum(1)
        return out, head[:, 5:6].clamp(-6, 0), head[:, 6:7].clamp(-6, 0)

    @staticmethod
    def unshuffle(x):  # channels: part by part, as in the program
        return torch.cat([x[:, :, i // 2::2, i % 2::2] for i in range(4)], 1)

    @staticmethod
    def shuffle(x):
        b, c, h, w = x.shape
        return x.reshape(b, 2, 2, c // 4, h, w).permute(0, 3, 4, 1, 5, 2).reshape(b, c // 4, 2 * h, 2 * w)


def loss_of(out, error, fault, render, truth):
    miss = out - truth
    square, before = miss.square().mean((1, 2, 3)), (render - truth).square().mean((1, 2, 3))
    edges = (miss[..., 1:] - miss[..., :-1]).abs().sum() + (miss[..., 1:, :] - miss[..., :-1, :]).abs().sum()
    size, first = miss.detach().abs().mean(1, keepdim=True), (render - truth).abs().mean(1, keepdim=True)
    likelihood = (size * (-error).exp() + error + first * (-fault).exp() + fault).mean()
    return (square / (before + 2e-3)).mean() + 2 * (miss.square() + 1e-3).sqrt().mean() + 0.5 * edges / miss.numel() + \
        0.02 * likelihood


def planes_of(pixels):  # (N,H,W,50) u8 -> frame, shown, truth
    x = torch.from_numpy(pixels.astype(np.float32)).permute(0, 3, 1, 2)
    shown = x[:, FRAME + 3:].unflatten(1, (REFERENCES, REFERENCE)) / 255
    for k in (3, 4, 5, 7, 13):
        shown[:, :, k] = (shown[:, :, k] * 255 - 128) / 127
    return x[:, :FRAME] / 255, shown, x[:, FRAME:FRAME + 3] / 255


def check(net, frames):
    def decibels(a, b):
        return -10 * float(np.log10(max(float((a - b).square().mean()), 1e-10)))
    sums = np.zeros(2)
    with torch.no_grad():
        for i in range(len(frames)):
            frame, shown, truth = planes_of(frames[i:i + 1])
            h, w = frame.shape[2:]
            pad = (0, -w % 16, 0, -h % 16)
            shown = F.pad(shown.flatten(1, 2), pad, "replicate").unflatten(1, (REFERENCES, REFERENCE))
            out = net.forward(F.pad(frame, pad, "replicate"), shown)[0]
            sums += decibels(frame[:, :3], truth), decibels(out[..., :h, :w].clamp(0, 1), truth)
    return sums / len(frames)


def time_torch(net, frames, steps):
    adam = torch.optim.AdamW(net.p.values(), lr=1e-3, betas=(0.9, 0.99), weight_decay=1e-4)
    crops = np.stack([frames[i % len(frames), 8:104, 8:104] for i in range(8)])
    frame, shown, truth = planes_of(crops)
    start = 0.0
    for step in range(steps + 3):
        if step == 3:
            start = time.process_time()
        loss = loss_of(*net.forward(frame, shown), frame[:, :3], truth)
        adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.p.values(), 1.0)
        adam.step()
        torch._foreach_lerp_(list(net.average.values()), [t.detach() for t in net.p.values()], 0.002)
    return (time.process_time() - start) / steps


def time_program(options, steps):
    def cpu(count):
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        subprocess.run([options.train, os.path.join(options.out, "timed.safetensors"), "--data", options.data, "--scenes",
                        options.scenes, "--check", "0", "--steps", str(count), "--threads", "1", "--save-every", "100000"],
                       check=True, stderr=subprocess.DEVNULL)
        return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    return (cpu(steps * 3 // 2) - cpu(steps // 2)) / (steps * 3 // 2 - steps // 2)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("train", "data", "scenes", "check", "out"):
        parser.add_argument("--" + name, required=True)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(1)
    os.makedirs(options.out, exist_ok=True)
    weights = os.path.join(options.out, "mini.safetensors")
    text = subprocess.run([options.train, weights, "--data", options.data, "--scenes", options.scenes, "--check", options.check,
                           "--steps", "60", "--threads", "1"], check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                          text=True).stdout
    frames = tensors_of(os.path.join(options.data, options.check + ".safetensors"))["frames"]
    print(text.splitlines()[0])
    print("PyTorch %s: %.2f -> %.2f dB" % ((torch.__version__,) + tuple(check(Mini(weights, 0), frames))))
    times = {"train_mini": [], "PyTorch, channels first": [], "PyTorch, channels last": []}
    for _ in range(options.runs):
        times["train_mini"].append(time_program(options, options.steps))
        for last, name in enumerate(list(times)[1:]):
            times[name].append(time_torch(Mini(weights, last), frames, options.steps))
    for name, values in times.items():
        print("%-24s %.4f CPU s a step, %.2f times train_mini" % (name, min(values), min(values) / min(times["train_mini"])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
