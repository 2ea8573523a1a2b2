#!/usr/bin/env -S uv run --script
# /// script
# requires-python = ">=3.10"
# dependencies = ["torch>=2.5", "numpy", "pillow", "safetensors"]
# ///
"""Monodepth2 in PyTorch with seeded random weights: what relcov's depth network is compared with.

    uv run data_scripts/monodepth2_reference.py --out /tmp/reference --size 640x192
    RELCOV_MONODEPTH2_REFERENCE=/tmp/reference cargo test --release --test suite monodepth2

Writes encoder.pth and depth.pth in the published format (keys, scalars beside the tensors, an unused fully
connected layer), an image, and reference.safetensors: the image's pixels after Pillow's Lanczos
filter, and the disparities at all four scales. The network is written from the description of its
layers (Godard et al. 2019), not from the published code.

`--compact` makes every weight a view into 8 kB of random numbers, so that the two files are small enough to be
kept with the tests; tests/data/monodepth2 was written by

    data_scripts/monodepth2_reference.py --compact --size 192x64 --image-size 250x80 --out tests/data/monodepth2

Without uv: pip install torch numpy pillow safetensors, then python data_scripts/monodepth2_reference.py.
"""

import argparse
from collections import OrderedDict
from pathlib import Path

import numpy
import torch
from torch import nn
from torch.nn import functional

DECODER_CHANNELS = [16, 32, 64, 128, 256]
ENCODER_CHANNELS = [64, 64, 128, 256, 512]
# Random numbers that all weights of compact files are views of.
POOL = 2048


class BasicBlock(nn.Module):
    def __init__(self, inputs, outputs, stride):
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        changes = stride != 1 or inputs != outputs
        self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)) if changes else None

    def forward(self, x):
        identity = x if self.downsample is None else self.downsample(x)
        x = functional.relu(self.bn1(self.conv1(x)))
        return functional.relu(self.bn2(self.conv2(x)) + identity)


class ResNet18(nn.Module):
    def __init__(self):
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        inputs = 64
        for index, outputs in enumerate(ENCODER_CHANNELS[1:], 1):
            layer = nn.Sequential(BasicBlock(inputs, outputs, 1 if index == 1 else 2), BasicBlock(outputs, outputs, 1))
            setattr(self, f"layer{index}", layer)
            inputs = outputs
        self.fc = nn.Linear(512, 1000)

    def forward(self, x):
        x = functional.relu(self.bn1(self.conv1((x - 0.45) / 0.225)))
        features = [x]
        x = functional.max_pool2d(x, 3, 2, 1)
        for layer in [self.layer1, self.layer2, self.layer3, self.layer4]:
            x = layer(x)
            features.append(x)
        return features


class Conv3x3(nn.Module):
    def __init__(self, inputs, outputs):
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3)

    def forward(self, x):
        return self.conv(functional.pad(x, (1, 1, 1, 1), mode="reflect"))


class ConvBlock(nn.Module):
    def __init__(self, inputs, outputs):
        super().__init__()
        self.conv = Conv3x3(inputs, outputs)

    def forward(self, x):
        return functional.elu(self.conv(x))


class Decoder(nn.Module):
    def __init__(self):
        super().__init__()
        blocks, inputs = [], ENCODER_CHANNELS[4]
        for level in (4, 3, 2, 1, 0):
            outputs = DECODER_CHANNELS[level]
            skip = ENCODER_CHANNELS[level - 1] if level else 0
            blocks += [ConvBlock(inputs, outputs), ConvBlock(outputs + skip, outputs)]
            inputs = outputs
        heads = [Conv3x3(DECODER_CHANNELS[scale], 1) for scale in range(4)]
        self.decoder = nn.ModuleList(blocks + heads)

    def forward(self, features, scales=range(4)):
        x, disparities = features[4], {}
        for step, level in enumerate((4, 3, 2, 1, 0)):
            x = functional.interpolate(self.decoder[2 * step](x), scale_factor=2, mode="nearest")
            if level:
                x = torch.cat([x, features[level - 1]], 1)
            x = self.decoder[2 * step + 1](x)
            if level in scales:
                disparities[level] = torch.sigmoid(self.decoder[10 + level](x))
        return disparities


class Encoder(nn.Module):
    def __init__(self):
        super().__init__()
        self.encoder = ResNet18()

    def forward(self, x):
        return self.encoder(x)


def randomise(module, generator, compact):
    """Seeded weights and biases; in compact files, views of a few random numbers."""
    pool = torch.randn(POOL, generator=generator)

    def normal(shape, place):
        if not compact:
            return torch.randn(shape, generator=generator)
        strides = [max(1, int((POOL - 1) / max(1, size - 1) / len(shape))) for size in shape]
        reach = sum((size - 1) * stride for size, stride in zip(shape, strides))
        return torch.as_strided(pool, shape, strides, place % (POOL - reach))

    for place, (key, value) in enumerate(module.named_parameters()):
        is_gain = value.dim() == 1 and key.endswith("weight")
        noise = normal(tuple(value.shape), 37 * place)
        value.data = 1 + 0.1 * noise if is_gain else noise


def settle(module, forward):
    """Brings activations to the order of 1, as in a trained network: batch norms take the statistics of this
    image, layers without one are divided by the spread of their output. Views stay views."""
    normalised = {id(layer) for block in module.modules() for layer in children_before_norm(block)}

    def rescale(layer, inputs, output):
        if id(layer) not in normalised:
            scale = 1 / output.std()
            layer.weight.data = scaled(layer.weight.data, scale)
            return output * scale + layer.bias.data[:, None, None] * (1 - scale)

    hooks = [layer.register_forward_hook(rescale) for layer in module.modules() if isinstance(layer, nn.Conv2d)]
    for layer in module.modules():
        if isinstance(layer, nn.BatchNorm2d):
            layer.momentum = 1.0
    module.train()
    with torch.no_grad():
        output = forward()
    [hook.remove() for hook in hooks]
    module.eval()
    return output


def children_before_norm(block):
    layers = list(block.children())
    return [layer for layer, norm in zip(layers, layers[1:]) if isinstance(layer, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)]


def scaled(view, scale):
    """The same view of a scaled pool."""
    pool = torch.as_strided(view, (view.untyped_storage().nbytes() // 4,), (1,), 0)
    return torch.as_strided(pool * scale, view.shape, view.stride(), view.storage_offset())


def picture(size, seed):
    """Smooth waves and noise, so that a wrong filter or a shifted pixel shows."""
    from PIL import Image

    width, height = size
    v, u = numpy.mgrid[:height, :width]
    noise = numpy.random.default_rng(seed).integers(-3, 4, (height, width, 3)) * 12
    waves = [127 + 80 * numpy.sin(u / a + 1.3 * c) * numpy.cos(v / b - c) for c, (a, b) in enumerate([(9, 7), (17, 5), (4, 13)])]
    return Image.fromarray(numpy.clip(numpy.stack(waves, -1) + noise, 0, 255).astype(numpy.uint8))


def size(text):
    width, height = map(int, text.split("x"))
    return width, height


def main():
    # Not needed by those who take the network alone.
    from PIL import Image
    from safetensors.torch import save_file

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--size", type=size, default=(640, 192), help="input of the network (default 640x192)")
    parser.add_argument("--image", type=Path, help="an image; default: one that is made")
    parser.add_argument("--image-size", type=size, default=(1226, 370), help="size of the made image")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--legacy", action="store_true", help="the file format of PyTorch before 1.6, that of the published files")
    parser.add_argument("--compact", action="store_true", help="files small enough to be kept")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    width, height = arguments.size

    image = Image.open(arguments.image).convert("RGB") if arguments.image else picture(arguments.image_size, arguments.seed)
    image.save(arguments.out / "image.png")
    pixels = torch.from_numpy(numpy.asarray(image.resize(arguments.size, Image.Resampling.LANCZOS)).copy())
    network_input = pixels.permute(2, 0, 1)[None].float() / 255

    encoder, decoder = Encoder(), Decoder()
    generator = torch.Generator().manual_seed(arguments.seed)
    for module in (encoder, decoder):
        randomise(module, generator, arguments.compact)
    features = settle(encoder, lambda: encoder(network_input))
    settle(decoder, lambda: decoder(features))
    with torch.inference_mode():
        disparities = decoder(encoder(network_input))

    published = OrderedDict(encoder.state_dict())
    published.update(height=height, width=width, use_stereo=False)
    for state, name in [(published, "encoder.pth"), (decoder.state_dict(), "depth.pth")]:
        torch.save(state, arguments.out / name, _use_new_zipfile_serialization=not arguments.legacy)
    tensors = {f"disparity_{scale}": disparity.contiguous() for scale, disparity in disparities.items()}
    save_file({"pixels": pixels, **tensors}, arguments.out / "reference.safetensors")
    for scale, disparity in sorted(disparities.items()):
        print(f"disparity {scale}: {tuple(disparity.shape)}, {disparity.min():.4f} to {disparity.max():.4f}, mean {disparity.mean():.4f}")


if __name__ == "__main__":
    main()
