"""AMT-S (Li et al. 2023) in PyTorch, for peers_metrics.py: the published network's layers in the order of its code (MCG-NKU/AMT,
networks/AMT-S.py), with all correlations in a volume, from the weights that bench_metrics writes.

    peer_amt.py WEIGHTS.safetensors IO.safetensors   compares it with the pairs of tests/golden/metricnets/amt
"""
import sys

import torch
import torch.nn.functional as F

LEVELS, RADIUS, FLOWS = 4, 3, 3


def resize(x, scale):
    return F.interpolate(x, scale_factor=scale, mode="bilinear", align_corners=False)


def sample(x, coordinates, padding):  # coordinates: (N, h, w, 2) in pixels
    size = torch.tensor([x.shape[3] - 1, x.shape[2] - 1], dtype=x.dtype)
    return F.grid_sample(x, 2 * coordinates / size - 1, mode="bilinear", padding_mode=padding, align_corners=True)


def places(height, width):  # (1, h, w, 2): x, y
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y], dim=-1)[None].float()


def warp(x, flow):
    return sample(x, places(*x.shape[2:]) + flow.permute(0, 2, 3, 1), "border")


class Correlation:
    def __init__(self, a, b):
        c, self.height, self.width = a.shape[1:]
        volume = torch.matmul(a.flatten(2)[0].t(), b.flatten(2)[0]) / c ** 0.5
        self.pyramids = [self.pyramid(volume), self.pyramid(volume.t())]

    def pyramid(self, volume):
        levels = [volume.reshape(-1, 1, self.height, self.width)]
        for _ in range(LEVELS - 1):
            levels.append(F.avg_pool2d(levels[-1], 2, 2))
        return levels

    def look_up(self, flow0, flow1):  # flows from the middle to the images
        reach = torch.arange(-RADIUS, RADIUS + 1).float()
        window = torch.stack(torch.meshgrid(reach, reach, indexing="ij"), dim=-1)[None]  # the offset in x varies slowest
        out = []
        for pyramid, flow in zip(self.pyramids, (flow1, flow0)):
            at = (places(self.height, self.width) + 2 * flow.permute(0, 2, 3, 1)).reshape(-1, 1, 1, 2)
            for i, level in enumerate(pyramid):
                out.append(sample(level, at / 2 ** i + window, "zeros").reshape(1, self.height, self.width, -1))
        return torch.cat(out, dim=-1).permute(0, 3, 1, 2).contiguous()


class Amt:
    def __init__(self, path):
        import safetensors.torch
        self.w = safetensors.torch.load_file(path)

    def conv(self, name, x, stride=1):
        weight = self.w[name + ".weight"]
        return F.conv2d(x, weight, self.w[name + ".bias"], stride, weight.shape[2] // 2)

    def prelu(self, name, x):
        return F.prelu(x, self.w[name + ".weight"])

    def both(self, name, x, stride=1):
        return self.prelu(name + ".1", self.conv(name + ".0", x, stride))

    def features(self, x):
        x = F.relu(F.instance_norm(self.conv("feat_encoder.conv1", x, 2)))
        for i in range(6):
            name, stride, y = "feat_encoder.layer%d.%d." % (i // 2 + 1, i % 2), 2 if i in (2, 4) else 1, x
            for k in range(3):
                y = F.relu(F.instance_norm(self.conv("%sconv%d" % (name, k + 1), y, stride if k == 1 else 1)))
            if name + "downsample.0.weight" in self.w:
                x = F.instance_norm(self.conv(name + "downsample.0", x, stride))
            x = F.relu(x + y)
        return self.conv("feat_encoder.conv2", x)

    def encoder(self, x):
        out = []
        for i in range(4):
            x = self.both("encoder.pyramid%d.1" % (i + 1), self.both("encoder.pyramid%d.0" % (i + 1), x, 2))
            out.append(x)
        return out

    def decoder(self, n, x):
        name = "decoder%d.convblock." % n
        a = self.both(name + "0", x)
        b = self.both(name + "1.conv1", a)
        for side, whole in (("conv2", "conv3"), ("conv4", "conv5")):
            c = self.w[name + "1.%s.0.weight" % side].shape[0]
            b[:, -c:] = self.both(name + "1." + side, b[:, -c:].clone())
            b = self.both(name + "1.conv3", b) if whole == "conv3" else self.prelu(name + "1.prelu", a + self.conv(name + "1.conv5", b))
        return F.conv_transpose2d(b, self.w[name + "2.weight"], self.w[name + "2.bias"], stride=2, padding=1)

    def update(self, n, features, flow, correlation, down):
        def act(part, x):
            return F.leaky_relu(self.conv("update%d.%s" % (n, part), x), 0.1)
        features = resize(features, 1 / down) if down > 1 else features
        mixed = torch.cat([act("convc1", correlation), act("convf2", act("convf1", flow))], 1)
        hidden = self.conv("update%d.gru.2" % n, act("gru.0", torch.cat([act("conv", mixed), flow, features], 1)))
        out = [self.conv("update%d.%s.2" % (n, head), act(head + ".0", hidden)) for head in ("feat_head", "flow_head")]
        return [resize(out[0], down), down * resize(out[1], down)] if down > 1 else out

    def interpolate(self, a, b):  # (1, 3, h, w) in [0, 1]
        high, wide = a.shape[2:]
        across, down = -wide % 16, -high % 16
        pads = [across // 2, across - across // 2, down // 2, down - down // 2]
        x = torch.cat([F.pad(a, pads, mode="replicate"), F.pad(b, pads, mode="replicate")])
        mean = x.mean()
        x = x - mean
        correlation = Correlation(*self.features(x).split(1))
        pyramid = self.encoder(x)
        f = pyramid[3]
        out = self.decoder(4, torch.cat([f[:1], f[1:], torch.full_like(f[:1, :1], 0.5)], 1))
        for n in (4, 3, 2):
            flow, features = out[:, :4], out[:, 4:]
            scale = 2 ** (4 - n)
            small = resize(flow, 1 / scale) / scale if scale > 1 else flow
            more = self.update(n, features, small, correlation.look_up(small[:, :2], small[:, 2:]), scale)
            flow, features, f = flow + more[1], features + more[0], pyramid[n - 2]
            warped = [warp(f[i:i + 1], flow[:, 2 * i:2 * i + 2]) for i in range(2)]
            out = self.decoder(n - 1, torch.cat([features, *warped, flow], 1))
            coarse = 2 * resize(flow, 2)
            if n > 2:
                out = torch.cat([out[:, :4] + coarse, out[:, 4:]], 1)
        flows = out[:, :12] + torch.cat([coarse[:, :2].repeat(1, FLOWS, 1, 1), coarse[:, 2:].repeat(1, FLOWS, 1, 1)], 1)
        flows = flows.reshape(2 * FLOWS, 2, *x.shape[2:])
        warped = [warp(x[i:i + 1].expand(FLOWS, -1, -1, -1), flows[i * FLOWS:(i + 1) * FLOWS]) for i in range(2)]
        mask = torch.sigmoid(out[0, 12:15])[:, None]
        candidates = mask * warped[0] + (1 - mask) * warped[1] + mean + out[0, 15:].reshape(FLOWS, 3, *x.shape[2:])
        merged = self.conv("comb_block.2", self.both("comb_block", candidates.reshape(1, 3 * FLOWS, *x.shape[2:])))
        merged = merged + candidates.mean(0, keepdim=True)
        return merged[:, :, pads[2]:pads[2] + high, pads[0]:pads[0] + wide].clamp(0, 1)


def main():
    import safetensors.torch
    net, io = Amt(sys.argv[1]), safetensors.torch.load_file(sys.argv[2])
    for pair, name, step in (("p0", "p0.imgt_pred.every2", 2), ("p1", "p1.imgt_pred", 1)):
        a, b = (io["%s.img%d" % (pair, i)].permute(2, 0, 1)[None].float() / 255 for i in range(2))
        with torch.inference_mode():
            got = net.interpolate(a, b)[0, :, ::step, ::step]
        print("%s: %.2g of the largest value" % (name, ((got - io[name]).abs().max() / io[name].abs().max()).item()))


if __name__ == "__main__":
    main()
