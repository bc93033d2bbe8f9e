#!/usr/bin/env python3
"""Runs bench_nn and then PyTorch on the same cases, and prints the ratio of the two.

    bench/peers_nn.py BENCH_NN [--quick] [--filter TEXT] [--threads N] [--rounds N]

BENCH_NN is the built program; its rows are passed through. Every case that PyTorch can do, too, is read from its name and
timed on as many threads right after; that row has variant "PyTorch" (beside our products of bf16 "PyTorch bf16") and
"ratio": PyTorch's seconds divided by ours (above 1: we are faster), "cpu_ratio" the same of CPU seconds, for machines that
do other things as well. --rounds repeats the two in turns; the median counts. Needs PyTorch (pip install torch), for the
transformer's and the autoencoder's block diffusers and for DINOv2 transformers, too; without PyTorch only our rows are
printed and the exit code is 77.

PyTorch makes a new tensor for every result. So that its time is that of the kernel and not of the pages that Linux fills with
zeros for a large one, up to four fifths of it, the C library is told to keep memory that was freed.
"""
import argparse
import json
import os
import re
import resource
import statistics
import subprocess
import sys
import time

try:
    import torch
except ImportError:
    torch = None

KEEP_MEMORY = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": "2000000000"}  # glibc reads them as a program starts
CYCLE_BYTES = 1 << 30  # up to 4 rows: over this much of distinct weights, as bench_nn does (a quarter with --quick)


def measure(function, units, quick):
    """Median seconds and least CPU seconds of one unit; function does `units` of them."""
    wall, cpu = [], []
    for _ in range(8):  # until it has all its memory
        faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        function()
        if resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults < 1000:
            break
    start = time.perf_counter()
    while len(wall) < 3 or (time.perf_counter() - start < (0.3 if quick else 1.5) and len(wall) < 100):
        t, c = time.perf_counter(), time.process_time()
        function()
        wall.append((time.perf_counter() - t) / units)
        cpu.append((time.process_time() - c) / units)
    return statistics.median(wall), min(cpu)


def linear(match, quick, low=False):
    dtype = {"f32": torch.float32, "bf16": torch.bfloat16, "f16": torch.float16}[match.group(1)]
    m, n, k = (int(match.group(i)) for i in (2, 3, 4))
    size = n * k * torch.tensor([], dtype=dtype).element_size()
    copies = max(1, (CYCLE_BYTES >> (2 if quick else 0)) // size) if m <= 4 else 1
    weights = [torch.rand(n, k).sub_(0.5).to(dtype) for _ in range(copies)]
    x, bias = torch.rand(m, k).sub_(0.5).to(dtype), torch.rand(n).to(dtype)
    after = {"": None, "gelu": lambda y: torch.nn.functional.gelu(y, approximate="tanh"),
             "silu": torch.nn.functional.silu}[match.group(5) or ""]

    def run():
        for w in weights:
            y = torch.nn.functional.linear(x, w, bias)
            if after:
                after(y)
    return run, copies


def attention(match, quick, low=False):
    heads, dim, q, k = (int(match.group(i)) for i in (1, 2, 3, 4))
    a, b, c = (torch.rand(1, n, heads, dim).sub_(0.5).mul_(3).to(torch.bfloat16 if low else torch.float32).transpose(1, 2)
               for n in (q, k, k))
    return lambda: torch.nn.functional.scaled_dot_product_attention(a, b, c), 1


def rows(match, quick):
    kind, n, dim = match.group(1), int(match.group(2)), int(match.group(3))
    f = torch.nn.functional
    x, w = torch.rand(n, dim).sub_(0.5), torch.rand(n if kind == "group_norm" else dim)

    def rope():  # as diffusers: norm of each head, then the rotation of pairs
        y = f.layer_norm(x.view(n, -1, 64), (64,), w[:64], w[:64], 1e-6)
        turned = y.reshape(n, -1, 32, 2)
        turned = torch.stack([-turned[..., 1], turned[..., 0]], -1).flatten(2)
        return y * table + turned * table
    table = torch.rand(n, 1, 64) if kind == "head_norm_rope" else None
    return {"layer_norm": lambda: f.layer_norm(x, (dim,), w, w, 1e-6),
            "layer_norm_modulated": lambda: f.layer_norm(x, (dim,), w, w, 1e-6) * (1 + w) + w,
            "rms_norm": lambda: f.rms_norm(x, (dim,), w, 1e-6), "head_norm_rope": rope,
            "group_norm": lambda: f.group_norm(x.view(1, n, dim), 32, w, w, 1e-6),
            "softmax": lambda: f.softmax(x, -1), "gelu": lambda: f.gelu(x, approximate="tanh"),
            "silu": lambda: f.silu(x)}[kind], 1


def better(runs):
    """The fastest of `runs`, each tried once."""
    seconds = []
    for run in runs:
        run()
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return runs[seconds.index(min(seconds))]


def conv3d(match, quick):
    """Causal: three frames of the input before each one of the output. The better of both memory layouts counts."""
    c, t, h, w = (int(match.group(i)) for i in (1, 2, 3, 4))
    x, weight = torch.rand(1, c, t + 2, h, w).sub_(0.5), torch.rand(c, c, 3, 3, 3).sub_(0.5)
    bias = torch.rand(c)
    inputs = [(x, weight), (x.to(memory_format=torch.channels_last_3d), weight.to(memory_format=torch.channels_last_3d))]
    return better([lambda pair=pair: torch.nn.functional.conv3d(*pair, bias, padding=(0, 1, 1)) for pair in inputs]), 1


def resnet(match, quick):
    """diffusers' CogVideoXResnetBlock3D: group norm, SiLU and convolution twice; the better of both memory layouts counts."""
    from diffusers.models.autoencoders.autoencoder_kl_cogvideox import CogVideoXResnetBlock3D
    c, t, h, w = (int(match.group(i)) for i in (1, 2, 3, 4))
    runs = []
    for layout in (torch.contiguous_format, torch.channels_last_3d):
        layer = CogVideoXResnetBlock3D(c, c, temb_channels=0).eval().to(memory_format=layout)
        x = torch.rand(1, c, t, h, w).sub_(0.5).to(memory_format=layout)
        runs.append(lambda layer=layer, x=x: layer(x))
    return better(runs), 1


def block(match, quick, low=False):
    """diffusers' CogVideoXBlock at the release's size, one sample; it has no cross-attention (R=0 only)."""
    from diffusers.models.transformers.cogvideox_transformer_3d import CogVideoXBlock
    tokens, text = int(match.group(2)), 226
    dtype = torch.bfloat16 if low else torch.float32
    layer = CogVideoXBlock(3072, 48, 64, 512, attention_bias=True).eval().to(dtype)
    video, words = (torch.rand(1, n, 3072, dtype=dtype) for n in (tokens - text, text))
    embedding = torch.rand(1, 512, dtype=dtype)
    table = torch.rand(tokens - text, 64), torch.rand(tokens - text, 64)
    return lambda: layer(video, words, embedding, image_rotary_emb=table), 1


def dinov2(match, quick):
    """transformers' model at DINOv2-L's sizes; all layers are one and the same, as in bench_nn."""
    import transformers
    height, width, layers = (int(match.group(i)) for i in (1, 2, 3))
    config = transformers.Dinov2WithRegistersConfig(hidden_size=1024, num_hidden_layers=1, num_attention_heads=16,
                                                    image_size=518, patch_size=14, attn_implementation="sdpa")
    model = transformers.Dinov2WithRegistersModel(config).eval()
    model.encoder.layer = torch.nn.ModuleList([model.encoder.layer[0]] * layers)
    model.config.num_hidden_layers = layers
    x = torch.rand(1, 3, height, width)
    return lambda: model(x).last_hidden_state[:, 5:], 1


def pair(match, quick):
    """A frame and a global block as VGGT's own code computes them: norms of q and k, two rotations, fused attention."""
    f, d, heads = torch.nn.functional, 1024, 16
    down, across, images = int(match.group(1)) // 14, int(match.group(2)) // 14, int(match.group(3))
    linear = lambda out, fan: (torch.rand(out, fan).sub_(0.5).mul_(0.03), torch.rand(out).sub_(0.5))
    qkv, out, up, low = linear(3 * d, d), linear(d, d), linear(4 * d, d), linear(d, 4 * d)
    ones, small = torch.ones(d), torch.ones(64)
    tokens = 5 + down * across
    x = torch.rand(images, tokens, d).sub_(0.5)
    places = torch.cartesian_prod(torch.arange(down), torch.arange(across)) + 1
    places = torch.cat([torch.zeros(5, 2, dtype=places.dtype), places])
    angles = torch.arange(max(down, across) + 1).float()[:, None] * 100.0 ** (-torch.arange(0, 32, 2).float() / 32)
    cos, sin = torch.cat([angles, angles], -1).cos(), torch.cat([angles, angles], -1).sin()

    def turned(y, where):  # halves of each head by row and column; pairs half of it apart
        parts = []
        for axis, part in enumerate(y.chunk(2, -1)):
            a, b = part.chunk(2, -1)
            parts.append(part * f.embedding(where[:, axis], cos) + torch.cat([-b, a], -1) * f.embedding(where[:, axis], sin))
        return torch.cat(parts, -1)

    def block(y, where):
        samples, n, _ = y.shape
        z = f.linear(f.layer_norm(y, (d,), ones, ones, 1e-5), *qkv)
        q, k, v = z.reshape(samples, n, 3, heads, 64).permute(2, 0, 3, 1, 4).unbind(0)
        q, k = f.layer_norm(q, (64,), small, small, 1e-5), f.layer_norm(k, (64,), small, small, 1e-5)
        a = f.scaled_dot_product_attention(turned(q, where), turned(k, where), v)
        y = y + f.linear(a.transpose(1, 2).reshape(samples, n, d), *out) * ones
        return y + f.linear(f.gelu(f.linear(f.layer_norm(y, (d,), ones, ones, 1e-5), *up)), *low) * ones

    def run():
        y = block(x, places)
        return block(y.view(1, images * tokens, d), places.repeat(images, 1))
    return run, 1


def t5_layer(match, quick):
    """The layers of transformers' T5Block (v1.1) at T5-XXL's size, one prompt; bf16: activations are bf16, too."""
    f, d, heads, hidden = torch.nn.functional, 4096, 64, 10240
    dtype = torch.float32 if match.group(1) == "f32" else torch.bfloat16
    n = int(match.group(2))
    x = torch.rand(1, n, d).sub_(0.5).to(dtype)
    q, k, v, out = (torch.rand(d, d).sub_(0.5).mul_(0.03).to(dtype) for _ in range(4))
    gate, up, down = (torch.rand(*s).sub_(0.5).mul_(0.03).to(dtype) for s in ((hidden, d), (hidden, d), (d, hidden)))
    ones, bias = torch.ones(d, dtype=dtype), torch.rand(1, heads, n, n).to(dtype)

    def norm(y):
        wide = y.float()
        return ones * (wide * torch.rsqrt(wide.pow(2).mean(-1, keepdim=True) + 1e-6)).to(dtype)

    def split(y):
        return y.view(1, n, heads, 64).transpose(1, 2)

    def run():  # attention as T5Attention has it; the better of that and the fused one counts
        y = norm(x)
        a, b, c = split(f.linear(y, q)), split(f.linear(y, k)), split(f.linear(y, v))
        if fused:
            a = f.scaled_dot_product_attention(a, b, c, attn_mask=bias, scale=1.0)
        else:
            a = f.softmax((a @ b.transpose(2, 3) + bias).float(), -1).to(dtype) @ c
        z = x + f.linear(a.transpose(1, 2).reshape(1, n, d), out)
        y = norm(z)
        return z + f.linear(f.gelu(f.linear(y, gate), approximate="tanh") * f.linear(y, up), down)

    seconds = {}
    for fused in (False, True):
        run()
        start = time.perf_counter()
        run()
        seconds[fused] = time.perf_counter() - start
    fused = min(seconds, key=seconds.get)
    return run, 1


LOW = "bf16 products"  # a variant of ours; PyTorch's side is computed in bf16 then

CASES = [ # name of a case, what makes (function, units)
    (re.compile(r"linear (f32|bf16|f16) M=(\d+) N=(\d+) K=(\d+)(?: (gelu|silu))?$"), linear),
    (re.compile(r"attention f32 H=(\d+) D=(\d+) Q=(\d+) K=(\d+)$"), attention),
    (re.compile(r"(layer_norm|layer_norm_modulated|rms_norm|head_norm_rope|group_norm|softmax|gelu|silu) f32 (\d+)x(\d+)$"),
     rows),
    (re.compile(r"conv3d f32 C=(\d+) T=(\d+) H=(\d+) W=(\d+)$"), conv3d),
    (re.compile(r"vae resnet C=(\d+) T=(\d+) H=(\d+) W=(\d+)$"), resnet),
    (re.compile(r"block (f32|bf16) S=(\d+) R=0$"), block),
    (re.compile(r"t5 layer (f32|bf16) S=(\d+)$"), t5_layer),
    (re.compile(r"dinov2 f32 (\d+)x(\d+) L=(\d+)$"), dinov2),
    (re.compile(r"vggt pair f32 (\d+)x(\d+) N=(\d+)$"), pair),
]


def peer_row(ours, quick):
    for pattern, make in CASES:
        match = pattern.match(ours["case"])
        low = ours["variant"] == LOW
        if not match:
            continue
        # PyTorch multiplies bf16 weights with bf16 only: where it has instructions for it, our float32 has no counterpart
        bf16, few = match.group(1) == "bf16", make is linear and int(match.group(2)) <= 4
        if low != bf16 and (make is block or (make is linear and not few and ours["isa"] == "avx512_bf16")):
            continue
        if make is linear and match.group(1) == "f16" and not few:
            continue  # takes PyTorch minutes on processors without products of f16
        torch.set_num_threads(ours["threads"])
        with torch.inference_mode():
            try:
                run, units = make(match, quick, True) if low else make(match, quick)
            except ImportError as missing:
                print("peers_nn.py: %s: %s" % (ours["case"], missing), file=sys.stderr)
                return None
            seconds, cpu = measure(run, units, quick)
        row = {key: ours[key] for key in ("bench", "case", "isa", "threads", "work", "work_unit")}
        row.update(variant="PyTorch bf16" if low else "PyTorch", seconds=seconds, cpu_seconds=cpu, rate=ours["work"] / seconds, reference="none",
                   peer=torch.__version__)
        if "peak_share" in ours:  # by the same peak
            row["peak_share"] = ours["peak_share"] * ours["seconds"] / seconds
        return row
    return None


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--filter")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--rounds", type=int, default=1)
    options = parser.parse_args()
    if not KEEP_MEMORY.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable] + sys.argv, {**os.environ, **KEEP_MEMORY})
    command = [options.bench, "--json"] + ["--quick"] * options.quick
    command += ["--filter", options.filter] if options.filter else []
    command += ["--threads", str(options.threads)] if options.threads else []
    pairs, best = {}, None
    for _ in range(options.rounds):
        for line in subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines():
            ours = json.loads(line)
            print(line, flush=True)
            if ours["case"].startswith("machine"):
                best = ours["isa"]  # the last ones are of the best instruction set
            if torch is None or ours["variant"] not in ("default", LOW) or ours["isa"] != best:
                continue
            theirs = peer_row(ours, options.quick)
            if theirs:
                pairs.setdefault((ours["case"], ours["variant"], ours["threads"]), []).append((ours, theirs))
    for rows in pairs.values():
        row = dict(rows[-1][1])
        row["ratio"] = round(statistics.median(t["seconds"] / o["seconds"] for o, t in rows), 3)
        row["cpu_ratio"] = round(statistics.median(t["cpu_seconds"] / o["cpu_seconds"] for o, t in rows), 3)
        print(json.dumps(row))
    if torch is None:
        print("peers_nn.py: PyTorch is not installed", file=sys.stderr)
        return 77
    return 0


if __name__ == "__main__":
    sys.exit(main())
