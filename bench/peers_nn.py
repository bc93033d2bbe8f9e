#!/usr/bin/env python3
"""Runs bench_nn and its peers on the same cases and prints the ratios.

    bench/peers_nn.py BENCH_NN [--quick] [--filter TEXT] [--threads N] [--rounds N]

BENCH_NN is the built program; its rows are passed through. Each case that a peer supports is parsed from its name and
timed right after ours with the same number of threads. That row has the peer as variant (with " bf16" appended if our
products are in bf16), "ratio" (the peer's seconds divided by ours; above 1 we are faster) and "cpu_ratio" (the same for
CPU seconds, for machines that are not idle). --rounds repeats all cases, alternating; the median is reported. The
peers:

    PyTorch    default configuration. Its float32 products are MKL's, which do not use AVX-512 on AMD; its 8-bit layers are
               FBGEMM's
    oneDNN     PyTorch with each linear layer by oneDNN on prepacked weights, with fused activations where the case is the
               layer itself; 8-bit layers by PyTorch's engine onednn
    OpenBLAS   from numpy: float32 products and the bias (needs threadpoolctl)
    oneDNN's product alone    8-bit layers without the quantization of input and output, which ours include

Needs PyTorch and numpy (pip install torch numpy threadpoolctl), diffusers for the blocks of the transformer and the
autoencoder, and transformers for DINOv2. Without PyTorch only our rows are printed and the exit code is 77.

PyTorch allocates a new tensor for every result. To measure the kernel instead of the zeroing of fresh pages, which
takes up to four fifths of the time for large results, the C library is configured to keep freed memory. Each library
chooses its kernels by processor: environment variables that override OpenBLAS's choice are removed.
"""
import argparse
import contextlib
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
try:
    import numpy
    import threadpoolctl
except ImportError:
    numpy = None

KEEP_MEMORY = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": "2000000000"}  # read by glibc at program start
CYCLE_BYTES = 1 << 30  # up to 4 rows: cycle through this much of weights, as bench_nn does (a quarter with --quick)


def measure(function, units, quick):
    """Median seconds and minimum CPU seconds of one unit; function runs `units` of them."""
    wall, cpu = [], []
    for _ in range(8):  # until it has allocated all its memory
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


@contextlib.contextmanager
def onednn_linears():
    """torch.nn.functional.linear by oneDNN, on weights that are packed at their first use."""
    plain, packed = torch.nn.functional.linear, {}

    def linear(x, w, bias=None):
        rows = x.numel() // x.shape[-1]
        if (id(w), rows) not in packed:  # w is kept alive, so that its id stays unique
            packed[id(w), rows] = torch.ops.mkldnn._reorder_linear_weight(w.detach(), rows), w
        return torch.ops.mkldnn._linear_pointwise(x, packed[id(w), rows][0], bias, "none", [], "")
    torch.nn.functional.linear = linear
    try:
        yield
    finally:
        torch.nn.functional.linear = plain


def linear_copies(m, size, quick):
    return max(1, (CYCLE_BYTES >> (2 if quick else 0)) // size) if m <= 4 else 1


def linear(match, quick, low=False):
    """The layer in each peer that supports it."""
    dtype = {"f32": torch.float32, "bf16": torch.bfloat16, "f16": torch.float16}[match.group(1)]
    m, n, k = (int(match.group(i)) for i in (2, 3, 4))
    copies = linear_copies(m, n * k * torch.tensor([], dtype=dtype).element_size(), quick)
    weights = [torch.rand(n, k).sub_(0.5).to(dtype) for _ in range(copies)]
    x, bias = torch.rand(m, k).sub_(0.5).to(dtype), torch.rand(n).to(dtype)
    kind = match.group(5) or ""
    after = {"": None, "gelu": lambda y: torch.nn.functional.gelu(y, approximate="tanh"),
             "silu": torch.nn.functional.silu}[kind]

    def pytorch():
        for w in weights:
            y = torch.nn.functional.linear(x, w, bias)
            if after:
                after(y)
    yield "PyTorch", pytorch, copies
    if dtype == torch.float16:
        return  # oneDNN takes minutes on processors without f16 products
    fused = {"": ("none", ""), "gelu": ("gelu", "tanh"), "silu": ("swish", "")}[kind]
    packed = [torch.ops.mkldnn._reorder_linear_weight(w, m) for w in weights]

    def onednn():
        for w in packed:
            torch.ops.mkldnn._linear_pointwise(x, w, bias, fused[0], [], fused[1])
    yield "oneDNN", onednn, copies
    if numpy is None or dtype != torch.float32 or kind:
        return
    del packed
    rows, shift, columns = x.numpy(), bias.numpy(), [w.numpy().T for w in weights]
    out = numpy.empty((m, n), numpy.float32)

    def openblas():
        for w in columns:
            numpy.matmul(rows, w, out=out)
            numpy.add(out, shift, out=out)
    with threadpoolctl.threadpool_limits(torch.get_num_threads(), user_api="blas"):
        yield "OpenBLAS", openblas, copies


def int8_linear(match, quick):
    """float32 input and output with quantized activations, like ours; and the product alone."""
    m, n, k = (int(match.group(i)) for i in (1, 2, 3))
    copies, bias = linear_copies(m, n * k, quick), torch.rand(n)
    x, w = torch.rand(m, k).sub_(0.5), torch.rand(n, k).sub_(0.5)
    steps = torch.full((n,), 0.5 / 127.0), torch.zeros(n, dtype=torch.long)
    for name, engine in (("PyTorch", "x86"), ("oneDNN", "onednn")):
        torch.backends.quantized.engine = engine
        layers = [torch.ao.nn.quantized.dynamic.Linear(k, n) for _ in range(copies)]
        for layer in layers:
            layer.set_weight_bias(torch.quantize_per_channel(w, *steps, 0, torch.qint8), bias)

        def run(layers=layers):
            for layer in layers:
                layer(x)
        yield name, run, copies
    if m > 4:
        a, b = (torch.randint(-127, 127, shape, dtype=torch.int8) for shape in ((m, k), (n, k)))
        yield "oneDNN's product alone", lambda: torch._int_mm(a, b.t()), 1


def attention(match, quick, low=False):
    heads, dim, q, k = (int(match.group(i)) for i in (1, 2, 3, 4))
    a, b, c = (torch.rand(1, n, heads, dim).sub_(0.5).mul_(3).to(torch.bfloat16 if low else torch.float32).transpose(1, 2)
               for n in (q, k, k))
    return lambda: torch.nn.functional.scaled_dot_product_attention(a, b, c), 1


def rows(match, quick):
    kind, n, dim = match.group(1), int(match.group(2)), int(match.group(3))
    f = torch.nn.functional
    x, w = torch.rand(n, dim).sub_(0.5), torch.rand(n if kind == "group_norm" else dim)

    def rope():  # as in diffusers: norm of each head, then rotation of pairs
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
    """The fastest of `runs`, after trying each once."""
    seconds = []
    for run in runs:
        run()
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return runs[seconds.index(min(seconds))]


def conv3d(match, quick):
    """Causal convolution over three input frames; the faster of both memory layouts is reported."""
    c, t, h, w = (int(match.group(i)) for i in (1, 2, 3, 4))
    x, weight = torch.rand(1, c, t + 2, h, w).sub_(0.5), torch.rand(c, c, 3, 3, 3).sub_(0.5)
    bias = torch.rand(c)
    inputs = [(x, weight), (x.to(memory_format=torch.channels_last_3d), weight.to(memory_format=torch.channels_last_3d))]
    return better([lambda pair=pair: torch.nn.functional.conv3d(*pair, bias, padding=(0, 1, 1)) for pair in inputs]), 1


def resnet(match, quick):
    """diffusers' CogVideoXResnetBlock3D: group norm, SiLU and convolution, twice; the faster of both memory layouts is reported."""
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


def dinov2(match, quick, low=False):
    """transformers' model at the size of DINOv2-L; all layers share their weights, as in bench_nn. low: everything in bf16."""
    import transformers
    height, width, layers = (int(match.group(i)) for i in (1, 2, 3))
    config = transformers.Dinov2WithRegistersConfig(hidden_size=1024, num_hidden_layers=1, num_attention_heads=16,
                                                    image_size=518, patch_size=14, attn_implementation="sdpa")
    model = transformers.Dinov2WithRegistersModel(config).eval()
    model.encoder.layer = torch.nn.ModuleList([model.encoder.layer[0]] * layers)
    model.config.num_hidden_layers = layers
    dtype = torch.bfloat16 if low else torch.float32
    model, x = model.to(dtype), torch.rand(1, 3, height, width).to(dtype)
    return lambda: model(x).last_hidden_state[:, 5:], 1


def pair(match, quick, low=False):
    """A frame and a global block as VGGT's own code computes them: norms of q and k, two rotations, fused attention. low:
    everything in bf16."""
    f, d, heads, dtype = torch.nn.functional, 1024, 16, torch.bfloat16 if low else torch.float32
    down, across, images = int(match.group(1)) // 14, int(match.group(2)) // 14, int(match.group(3))
    linear = lambda out, fan: (torch.rand(out, fan).sub_(0.5).mul_(0.03).to(dtype), torch.rand(out).sub_(0.5).to(dtype))
    qkv, out, up, down_again = linear(3 * d, d), linear(d, d), linear(4 * d, d), linear(d, 4 * d)
    ones, small = torch.ones(d, dtype=dtype), torch.ones(64, dtype=dtype)
    tokens = 5 + down * across
    x = torch.rand(images, tokens, d).sub_(0.5).to(dtype)
    places = torch.cartesian_prod(torch.arange(down), torch.arange(across)) + 1
    places = torch.cat([torch.zeros(5, 2, dtype=places.dtype), places])
    angles = torch.arange(max(down, across) + 1).float()[:, None] * 100.0 ** (-torch.arange(0, 32, 2).float() / 32)
    cos, sin = torch.cat([angles, angles], -1).cos().to(dtype), torch.cat([angles, angles], -1).sin().to(dtype)

    def turned(y, where):  # halves of each head by row and column; pairs are half of that apart
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
        return y + f.linear(f.gelu(f.linear(f.layer_norm(y, (d,), ones, ones, 1e-5), *up)), *down_again) * ones

    def run():
        y = block(x, places)
        return block(y.view(1, images * tokens, d), places.repeat(images, 1))
    return run, 1


def t5_layer(match, quick, low=False):
    """The layers of transformers' T5Block (v1.1) at the size of T5-XXL, one prompt; bf16: activations are bf16 as well."""
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

    def run():  # attention as in T5Attention; the faster of that and fused attention is reported
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


LOW = "bf16 products"  # a variant of ours; the peers then compute in bf16

CASES = [  # pattern of the case's name, generator of (function, units)
    (re.compile(r"linear (f32|bf16|f16) M=(\d+) N=(\d+) K=(\d+)(?: (gelu|silu))?$"), linear),
    (re.compile(r"linear int8 M=(\d+) N=(\d+) K=(\d+)$"), int8_linear),
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
WITH_LINEARS = (block, t5_layer, dinov2, pair)


def peers_of(ours, match, make, quick):
    """(name, function, units) of each peer that supports the case; its data live only while it is the current one."""
    low = ours["variant"] == LOW
    if make in (linear, int8_linear):
        yield from make(match, quick)
        return
    arguments = (match, quick, True) if low else (match, quick)
    yield ("PyTorch",) + make(*arguments)
    if make in WITH_LINEARS:
        with onednn_linears():
            yield ("oneDNN",) + make(*arguments)


def compute_in_bf16(ours, match):
    return ours["variant"] == LOW or match.group(1) == "bf16"


def comparable(ours, match, make):
    low, bf16, few = ours["variant"] == LOW, match.group(1) == "bf16", make is linear and int(match.group(2)) <= 4
    # PyTorch multiplies bf16 weights by bf16 activations only: with bf16 instructions, our float32 products have no peer
    if low != bf16 and (make is block or (make is linear and not few and ours["isa"] in ("avx512_bf16", "amx"))):
        return False
    return not (make is linear and match.group(1) == "f16" and not few)  # takes PyTorch minutes


def peer_rows(ours, quick, limits):
    for pattern, make in CASES:
        match = pattern.match(ours["case"])
        if not match or not comparable(ours, match, make):
            continue
        torch.set_num_threads(ours["threads"])
        with torch.inference_mode():
            try:
                for name, run, units in peers_of(ours, match, make, quick):
                    seconds, cpu = measure(run, units, quick)
                    row = {key: ours[key] for key in ("bench", "case", "isa", "threads", "work", "work_unit")}
                    row.update(variant=name + " bf16" * (ours["variant"] == LOW), seconds=seconds, cpu_seconds=cpu,
                               rate=ours["work"] / seconds, reference="none",
                               peer=numpy.__version__ if name == "OpenBLAS" else torch.__version__)
                    limit = limits.get((ours["threads"], "bf16 dot products" if compute_in_bf16(ours, match) else
                                        "integer dot products" if make is int8_linear else "multiply-add"))
                    if "peak_share" in ours and limit:
                        row["peak_share"] = row["rate"] / limit
                    yield row
            except (ImportError, NotImplementedError, RuntimeError) as missing:
                print("peers_nn.py: %s: %s" % (ours["case"], str(missing).splitlines()[0]), file=sys.stderr)
        return


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--filter")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--rounds", type=int, default=1)
    options = parser.parse_args()
    wanted = {**{key: value for key, value in os.environ.items() if not key.startswith("OPENBLAS_")}, **KEEP_MEMORY}
    if wanted != dict(os.environ):
        os.execve(sys.executable, [sys.executable] + sys.argv, wanted)
    command = [options.bench, "--json"] + ["--quick"] * options.quick
    command += ["--filter", options.filter] if options.filter else []
    command += ["--threads", str(options.threads)] if options.threads else []
    pairs, limits, best = {}, {}, None
    for _ in range(options.rounds):
        for line in subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines():
            ours = json.loads(line)
            print(line, flush=True)
            if ours["case"].startswith("machine: "):
                if not ours["case"].startswith("machine: sweep"):  # the last ones are of the best instruction set
                    best, limits[ours["threads"], ours["case"][9:]] = ours["isa"], ours["rate"]
                continue
            if torch is None or ours["variant"] not in ("default", LOW) or ours["isa"] != best:
                continue
            for theirs in peer_rows(ours, options.quick, limits):
                pairs.setdefault((ours["case"], theirs["variant"], ours["threads"]), []).append((ours, theirs))
    for rows in pairs.values():
        row = dict(rows[-1][1])
        row["ratio"] = round(statistics.median(t["seconds"] / o["seconds"] for o, t in rows), 3)
        row["cpu_ratio"] = round(statistics.median(t["cpu_seconds"] / o["cpu_seconds"] for o, t in rows), 3)
        print(json.dumps(row))
    for name, package in (("PyTorch", torch), ("numpy and threadpoolctl", numpy)):
        if package is None:
            print("peers_nn.py: no %s here" % name, file=sys.stderr)
    return 0 if torch else 77


if __name__ == "__main__":
    sys.exit(main())
