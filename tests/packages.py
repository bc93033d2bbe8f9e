"""gsfix metrics beside Python packages; see packages.sh. Usage: packages.py GSFIX"""
import importlib.util
import json
import math
import os
import subprocess
import sys
import tempfile

import lpips
import numpy as np
import pytorch_msssim
import skimage.metrics
import torch
import torchmetrics.functional.image as tm
import torchvision
from PIL import Image
from safetensors.torch import save_file

FAILED = []
LPIPS = {"alex": "alexnet-owt-7be5be79", "vgg": "vgg16-397923af", "squeeze": "squeezenet1_1-b8a52dc0"}


def compare(name, ours, theirs, bar):
    error = abs(ours - theirs)
    ok = error <= bar or (math.isinf(theirs) and ours == theirs)
    print("%-28s %.9f  %.9f  %.1e%s" % (name, ours, theirs, error, "" if ok else "  above %.1e" % bar))
    if not ok:
        FAILED.append(name)


def gsfix(*arguments):
    command = [sys.argv[1], "metrics", "--json", "--threads", "1", *arguments]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL).stdout)


def clip(folder, count, height, width, seed):
    """Smooth moving pictures with noise, as bytes."""
    generator = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    os.mkdir(folder)
    frames = []
    for t in range(count):
        waves = [127 + 80 * np.sin(x / (9 + 4 * c) + 0.3 * t) * np.cos(y / (11 + 3 * c)) for c in range(3)]
        noise = generator.normal(0, 12, (height, width, 3))
        frames.append(np.clip(np.rint(np.stack(waves, -1) + noise), 0, 255).astype(np.uint8))
        Image.fromarray(frames[-1]).save("%s/%03d.png" % (folder, t))
    return frames


def tensor(image):
    return torch.from_numpy(image.astype(np.float64) / 255).permute(2, 0, 1)[None]


def pixels(root):
    for height, width in ((180, 200), (203, 251)):
        a, b = "%s/a%d" % (root, height), "%s/b%d" % (root, height)
        x, y = clip(a, 2, height, width, 1)[0], clip(b, 2, height, width, 2)[0]
        names = "psnr,ssim_torchmetrics,ssim_skimage,ms_ssim,ms_ssim_torchmetrics,temporal_flickering"
        got, size = gsfix(a, b, "--which", names), " %dx%d" % (width, height)
        ours = got["per_image"][0]
        compare("PSNR" + size, ours["psnr"], skimage.metrics.peak_signal_noise_ratio(y, x), 1e-9)
        compare("SSIM scikit-image" + size, ours["ssim_skimage"],
                skimage.metrics.structural_similarity(x.astype(np.float64), y.astype(np.float64), channel_axis=2,
                                                      data_range=255), 1e-7)
        p, q = tensor(x), tensor(y)
        compare("SSIM torchmetrics" + size, ours["ssim_torchmetrics"],
                tm.structural_similarity_index_measure(p, q, data_range=1.0).item(), 1e-7)
        compare("MS-SSIM pytorch-msssim" + size, ours["ms_ssim"],
                pytorch_msssim.ms_ssim(p, q, data_range=1.0).item(), 3e-6)  # its window is float32
        compare("MS-SSIM torchmetrics" + size, ours["ms_ssim_torchmetrics"],
                tm.multiscale_structural_similarity_index_measure(p, q, data_range=1.0, normalize="relu").item(), 1e-6)


def random_lpips(root):
    for net, backbone in LPIPS.items():
        torch.manual_seed(7)
        models = "%s/%s" % (root, net)
        os.mkdir(models)
        model = {"alex": torchvision.models.alexnet, "vgg": torchvision.models.vgg16,
                 "squeeze": torchvision.models.squeezenet1_1}[net](weights=None).eval()
        loss = lpips.LPIPS(net=net, pretrained=True, pnet_rand=True, verbose=False).double().eval()
        state = model.state_dict()
        for name, value in loss.net.state_dict().items():  # slices of `features`, which keep their numbers
            state["features." + name.split(".", 1)[1]] = value.float()
        save_file({k: v.contiguous() for k, v in state.items()}, "%s/%s.safetensors" % (models, backbone))
        heads = {k: v.float() for k, v in loss.state_dict().items() if k.startswith("lin") and not k.startswith("lins")}
        save_file(heads, "%s/%s.safetensors" % (models, net))
        a, b = models + "/a", models + "/b"
        x, y = clip(a, 1, 97, 131, 3)[0], clip(b, 1, 97, 131, 4)[0]
        got = gsfix(a, b, "--which", "lpips_%s,lpips_%s_raw" % (net, net), "--models", models)["per_image"][0]
        with torch.inference_mode():
            for raw in (False, True):
                name = "lpips_%s%s" % (net, "_raw" if raw else "")
                theirs = loss(tensor(x), tensor(y), normalize=not raw).item()
                compare(name, got[name], theirs, 3e-6 * abs(theirs))


def transformers():
    """dreamsim's file of DINO's transformer, without the rest of the package."""
    place = importlib.util.find_spec("dreamsim").submodule_search_locations[0]
    spec = importlib.util.spec_from_file_location("dino", place + "/feature_extraction/vision_transformer.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class QuickGELU(torch.nn.Module):
    def forward(self, x):
        return x * torch.sigmoid(1.702 * x)


def tower(dino, kind):
    """One of DreamSim's three, with two heads of 64 channels and three blocks."""
    eps = 1e-6 if kind == "dino" else 1e-5
    model = dino.VisionTransformer(patch_size=16, embed_dim=128, depth=3, num_heads=2, mlp_ratio=4, qkv_bias=True,
                                   norm_layer=lambda d: torch.nn.LayerNorm(d, eps=eps))
    for p in model.parameters():
        torch.nn.init.normal_(p, 0.0, 0.08 if p.ndim > 1 else 0.3)
    state = model.state_dict()
    if kind != "dino":
        model.pos_drop = torch.nn.LayerNorm(128, eps=eps)
        torch.nn.init.normal_(model.pos_drop.weight, 1.0, 0.1)
        model.proj = torch.nn.Parameter(torch.randn(128, 96) * 0.1)
        state = model.state_dict()
    if kind == "clip":
        for block in model.blocks:
            block.mlp.act = QuickGELU()
    return model.double().eval(), {k: v.float().contiguous() for k, v in state.items()}


def score(features):
    """VBench's i2v formula; the first feature is that of the input image."""
    unit = torch.nn.functional.normalize(torch.stack(features), dim=-1)
    to_input = (unit[1:] @ unit[0]).clamp(min=0)
    to_last = (unit[2:] * unit[1:-1]).sum(-1).clamp(min=0)
    return (0.4 * to_input.max() + 0.3 * to_last.mean() + 0.3 * to_last.min()).item()


def consistency(root):
    torch.manual_seed(5)
    dino, f = transformers(), torchvision.transforms.functional
    models = root + "/vits"
    os.makedirs(models + "/ensemble_lora")
    kinds = {"dino": "dino_vitbase16_pretrain", "clip": "clip_vitb16_pretrain", "open_clip": "open_clip_vitb16_pretrain"}
    towers, lora = [], {}
    for index, (kind, file) in enumerate(kinds.items()):
        model, state = tower(dino, kind)
        save_file(state, "%s/%s.safetensors" % (models, file))
        towers.append(model)
        for i, block in enumerate(model.blocks):
            a, b = torch.randn(4, 128) * 0.1, torch.randn(384, 4) * 0.1
            name = "base_model.model.extractor_list.%d.model.blocks.%d.attn.qkv.lora_%%s.weight" % (index, i)
            lora[name % "A"], lora[name % "B"] = a, b
    save_file(lora, models + "/ensemble_lora/adapter_model.safetensors")
    with open(models + "/ensemble_lora/adapter_config.json", "w") as out:
        json.dump({"r": 4, "lora_alpha": 8}, out)
    frames = clip(root + "/frames", 5, 120, 176, 8)
    image = clip(root + "/image", 1, 240, 266, 9)[0]
    got = gsfix(root + "/frames", root + "/image", "--which", "i2v_subject,i2v_background", "--models", models)
    mean, deviation = (torch.tensor(v, dtype=torch.float64)[:, None, None] for v in
                       ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    clip_mean, clip_deviation = (torch.tensor(v, dtype=torch.float64)[:, None, None] for v in
                                 ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)))
    bicubic = f.InterpolationMode.BICUBIC
    inputs = [torch.from_numpy(v).permute(2, 0, 1).float() for v in frames]
    with torch.inference_mode():
        small = f.resize(Image.fromarray(image), 256, bicubic)
        cropped = [f.pil_to_tensor(f.center_crop(small, 224)).double() / 255]
        cropped += [f.center_crop(f.resize(v, 256, bicubic, antialias=True), 224).double() / 255 for v in inputs]
        compare("i2v_subject", got["i2v_subject"],
                score([towers[0](((v - mean) / deviation)[None])[0] for v in cropped]), 2e-6)
        for index, model in enumerate(towers):
            for i, block in enumerate(model.blocks):
                name = "base_model.model.extractor_list.%d.model.blocks.%d.attn.qkv.lora_%%s.weight" % (index, i)
                block.attn.qkv.weight.add_(2.0 * lora[name % "B"].double() @ lora[name % "A"].double())
        whole = [f.pil_to_tensor(f.resize(Image.fromarray(image), (224, 224), bicubic)).double() / 255]
        whole += [f.resize(v, (224, 224), bicubic, antialias=True).double() / 255 for v in inputs]
        features = []
        for v in whole:
            x = towers[0].prepare_tokens(((v - mean) / deviation)[None])
            for block in towers[0].blocks:
                x = block(x)
            parts = [x[0, 0]]  # before the final norm
            parts += [model(((v - clip_mean) / clip_deviation)[None])[0] @ model.proj for model in towers[1:]]
            joined = torch.cat(parts)
            joined = joined - joined.mean()
            features.append(joined / joined.norm())
        compare("i2v_background", got["i2v_background"], score(features), 2e-6)


def main():
    torch.set_num_threads(1)
    print("%-28s %-12s %-12s difference" % ("", "gsfix", "package"))
    with tempfile.TemporaryDirectory() as root:
        pixels(root)
        random_lpips(root)
        consistency(root)
    if FAILED:
        sys.exit("packages.py: too far off: " + ", ".join(FAILED))


main()
