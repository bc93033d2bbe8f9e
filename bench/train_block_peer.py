#!/usr/bin/env python3
"""A block of the paper's transformer, forwards and backwards, beside the same block in PyTorch, on one core.

    bench/train_block_peer.py --make-model build/make_model --out DIR [--bf16] [--runs 3] [--cc cc]

Compiles bench/train_block.c, makes one block of the release's size (3072 wide, 48 heads of 64) with random weights in DIR/model
unless it is there, and runs it on 1,056 tokens with 1,850 reference tokens, all in f32: the output, and the gradients of the
input, the references, the time embedding and all weights. Both take turns; the fastest of --runs counts, in CPU time. PyTorch
runs its layers (MKL) and the same ones with the weights packed by oneDNN where that serves gradients, and keeps its
intermediates. With --bf16, ours rounds the operands of its products to bfloat16; PyTorch does so by autocast and, in another
turn, has all weights, activations and gradients in bfloat16. That both blocks are the same is shown by the largest relative error (L2) of the gradients, computed here from
PyTorch's. Needs numpy and torch (its CPU build is enough).
"""
import argparse
import json
import os
import struct
import subprocess
import time

import numpy as np
import torch
import torch.nn.functional as F

HEADS = 48


def tensors_of(path):
    data = np.memmap(path, np.uint8, "r")
    size = struct.unpack("<Q", data[:8].tobytes())[0]
    out = {}
    for name, t in json.loads(data[8:8 + size].tobytes()).items():
        if name == "__metadata__":
            continue
        raw = data[8 + size + t["data_offsets"][0]:8 + size + t["data_offsets"][1]]
        if t["dtype"] == "BF16":
            values = (raw.view(np.uint16).astype(np.uint32) << 16).view(np.float32)
        else:
            values = raw.view(np.float32)
        out[name] = torch.from_numpy(values.reshape(t["shape"]).copy())
    return out


class Block:
    def __init__(self, model, run, dtype=torch.float32):
        before = "transformer_blocks.0."
        files = os.path.join(model, "transformer", "diffusion_pytorch_model.safetensors")
        self.p = {n[len(before):]: t.to(dtype).requires_grad_() for n, t in tensors_of(files).items() if n.startswith(before)}
        self.cos, self.sin = run["cos"].to(dtype), run["sin"].to(dtype)
        self.text = len(run["x"]) - len(self.cos)

    def linear(self, name, x):
        return F.linear(x, self.p[name + ".weight"], self.p.get(name + ".bias"))

    def norm(self, name, x, eps):
        return F.layer_norm(x, x.shape[-1:], self.p[name + ".weight"], self.p[name + ".bias"], eps)

    def modulate(self, name, x, time):
        m = self.linear(name + ".linear", time).chunk(6, 1)
        n = self.norm(name + ".norm", x, 1e-5)
        text, video = n[:self.text], n[self.text:]
        return torch.cat([text * (1 + m[4]) + m[3], video * (1 + m[1]) + m[0]]), m[5], m[2]

    def heads(self, name, x, norm, rotate):
        y = self.linear(name, x).view(len(x), HEADS, -1)
        if norm:
            y = self.norm(norm, y, 1e-6)
        if rotate:
            text, video = y[:self.text], y[self.text:]
            pairs = video.unflatten(-1, (-1, 2))
            turned = torch.stack([-pairs[..., 1], pairs[..., 0]], -1).flatten(-2)
            y = torch.cat([text, video * self.cos[:, None] + turned * self.sin[:, None]])
        return y.transpose(0, 1)[None]

    def attend(self, name, x, keys, rotate):
        q = self.heads(name + ".to_q", x, name + ".norm_q", rotate)
        k = self.heads(name + ".to_k", keys, name + ".norm_k", rotate)
        v = self.heads(name + ".to_v", keys, None, False)
        y = F.scaled_dot_product_attention(q, k, v)[0].transpose(0, 1).reshape(len(x), -1)
        return self.linear(name + ".to_out.0", y)

    def gated(self, x, y, text_gate, video_gate):
        return x + torch.cat([text_gate * y[:self.text], video_gate * y[self.text:]])

    def __call__(self, x, references, time):
        n, text_gate, video_gate = self.modulate("norm1", x, time)
        x = self.gated(x, self.attend("attn1", n, n, True), text_gate, video_gate)
        text, video = x[:self.text], x[self.text:]
        video = video + self.attend("attn_cross", self.norm("norm_cross", video, 1e-5), references, False)
        x = torch.cat([text, video])
        n, text_gate, video_gate = self.modulate("norm2", x, time)
        y = self.linear("ff.net.2", F.gelu(self.linear("ff.net.0.proj", n), approximate="tanh"))
        return self.gated(x, y, text_gate, video_gate)


def step(block, run, autocast=False):
    dtype = block.p["attn1.to_q.weight"].dtype
    inputs = [run[n].to(dtype, copy=True).requires_grad_() for n in ("x", "references", "time")]
    dy = run["dy"].to(dtype)
    for p in block.p.values():
        p.grad = None
    begin = time.process_time()
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        y = block(*inputs)
    y.backward(dy.to(y.dtype))
    return time.process_time() - begin, inputs


def median(errors):
    return sorted(errors.values())[len(errors) // 2]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--make-model", required=True)
    parser.add_argument("--out", required=True)
    parser.add_argument("--bf16", action="store_true")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--cc", default="cc")
    o = parser.parse_args()
    torch.set_num_threads(1)
    os.makedirs(o.out, exist_ok=True)
    here = os.path.dirname(os.path.abspath(__file__))
    program, model = os.path.join(o.out, "train_block"), os.path.join(o.out, "model")
    subprocess.check_call([o.cc, "-O2", "-std=c11", "-fopenmp", "-I", os.path.dirname(here),
                           os.path.join(here, "train_block.c"), "-o", program, "-lm"])
    if not os.path.exists(model):
        subprocess.check_call([o.make_model, model, "--size", "full", "--layers", "1", "--parts", "transformer"])
    file = os.path.join(o.out, "run.safetensors")
    ours, theirs, block = [], {"MKL": [], "oneDNN": []}, None
    if o.bf16:
        theirs = {"autocast": [], "all bf16": []}
    for _ in range(o.runs):
        # the first run touches memory for the first time
        out = subprocess.check_output([program, model, file, "--runs", "2", "--threads", "1", "--bf16", str(int(o.bf16))],
                                      text=True)
        ours.append(float(out.splitlines()[-1].split()[2]))
        run = tensors_of(file)
        if block is None:
            block = Block(model, run)
            rounded = Block(model, run, torch.bfloat16) if o.bf16 else None
        for name in theirs:
            with torch.backends.mkldnn.flags(enabled=name != "MKL"):
                seconds, inputs = step(rounded if name == "all bf16" else block, run, name == "autocast")
            theirs[name].append(seconds)
    if o.bf16:  # what both are compared to
        rounded_grads = {n: p.grad.float() for n, p in rounded.p.items()}
        inputs = step(block, run)[1]
        by_torch = {n: float((g - block.p[n].grad).norm() / block.p[n].grad.norm()) for n, g in rounded_grads.items()
                    if "norm_k.bias" not in n}
    errors = {n: float((g - run["d" + n]).norm() / g.norm())
              for n, g in zip(("x", "references", "time"), (t.grad for t in inputs))}
    for name, p in block.p.items():
        if "norm_k.bias" not in name:  # a constant added to all keys: without rotation its gradient is zero
            errors[name] = float((p.grad - run["transformer_blocks.0." + name]).norm() / p.grad.norm())
    worst = max(errors, key=errors.get)
    print(f"{len(run['x'])} tokens, {len(run['references'])} reference tokens; PyTorch {torch.__version__}")
    print(f"largest relative error of {len(errors)} gradients: {errors[worst]:.1e} ({worst})")
    if o.bf16:
        worst = max(by_torch, key=by_torch.get)
        print(f"that of PyTorch all in bf16: {by_torch[worst]:.1e} ({worst}); medians {median(errors):.1e}, "
              f"PyTorch {median(by_torch):.1e}")
    print(f"gsfixer  {min(ours):.2f} CPU s  {['%.2f' % s for s in ours]}")
    for name, seconds in theirs.items():
        print(f"PyTorch {name}  {min(seconds):.2f} CPU s  {['%.2f' % s for s in seconds]}")
    print(f"ratio to the faster: {min(min(s) for s in theirs.values()) / min(ours):.2f}")


if __name__ == "__main__":
    main()
