#!/usr/bin/env -S uv run --script
# /// script
# requires-python = ">=3.10"
# dependencies = ["torch>=2.5", "numpy", "opencv-python-headless"]
# ///
"""Times relcov beside PyTorch, on this machine, in one run, and writes docs/performance.md.

    uv run data_scripts/bench_peer.py                        # everything; about 20 minutes on 2 cores
    uv run data_scripts/bench_peer.py --only forward         # lines whose name holds a word; prints only
    uv run data_scripts/bench_peer.py --depth                # the depth network's table alone
    uv run data_scripts/bench_peer.py --latency              # one pair from end to end alone
    uv run --with open3d data_scripts/bench_peer.py --alignment   # the alignment alone, beside Open3D
    uv run data_scripts/bench_peer.py --gpu vulkan cuda      # PyTorch CUDA beside these devices of relcov;
                                                             # writes docs/results/gpu.md

Without uv: pip install torch numpy opencv-python-headless (open3d for the alignment), then
python data_scripts/bench_peer.py.

Each measurement is a process of its own, so that peak memory is that of the case; relcov's and
PyTorch's take turns for several rounds, and the medians of all rounds are compared. PyTorch runs eagerly
in f32, in both memory layouts, of which the faster counts; its training step once with its default Adam
and once with its fused one. Both sides get the same number of threads.
"""

import argparse
import datetime
import importlib.util
import json
import math
import os
import platform
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "performance.md"

# Mode, height, width, batch, runs in a process, aimed ratio to PyTorch's time.
CASES = [
    ("train", 96, 320, 8, 6, 0.70),
    ("train", 192, 640, 4, 4, 0.65),
    ("forward", 96, 320, 1, 40, 0.85),
    ("forward", 192, 640, 1, 20, 0.85),
    ("forward", 320, 1024, 1, 10, 0.85),
    ("warp", 160, 512, 8, 40, 0.50),
]
# The depth network.
DEPTH_CASES = [
    ("depth", 192, 640, 1, 10, 1.00),
    ("depth", 192, 640, 4, 4, 1.00),
    ("depth", 320, 1024, 1, 6, 1.00),
    ("depth", 320, 1024, 4, 3, 1.00),
]
# One pair from end to end: two JPEG files of KITTI's size, depth given.
LATENCY_CASES = [("latency", 160, 512, 1, 200, 0.50), ("latency", 96, 320, 1, 200, 0.50)]
# Height, width, pairs at once (0: one alone on one thread), runs in a process, aimed ratio to Open3D's time.
ALIGNMENT_CASES = [(160, 512, 0, 100, 0.50), (160, 512, 16, 20, 0.50), (64, 192, 0, 300, 0.50), (64, 192, 16, 60, 0.50)]
# Open3D's iterations on each level, coarse to fine; relcov takes as many as it needs to come to rest, at most eight, and
# on the finest level twice.
ALIGNMENT_ITERATIONS = [5, 5, 5]
# Where the two files are, unless --images names others.
LATENCY_IMAGES = "../shared/kitti/2011_09_30/2011_09_30_drive_0018_sync/image_02/data/000000000{}.jpg"
# Mode, height, width, batch, runs, threads; None: all of them.
SCALING = [
    ("train", 96, 320, 1, 12, None),
    ("train", 96, 320, 4, 12, None),
    ("train", 96, 320, 12, 6, 1),
    ("train", 96, 320, 12, 6, None),
    ("train", 96, 320, 28, 4, None),
    ("train", 96, 320, 84, 2, None),
    ("train", 192, 640, 1, 6, None),
    ("train", 192, 640, 12, 2, None),
    ("forward", 96, 320, 1, 40, 1),
    ("forward", 96, 320, 28, 6, None),
    ("forward", 192, 640, 1, 20, 1),
]


# --- PyTorch's side: one measurement a process -------------------------------------------------


def torch_network(torch, height, width):
    """Table I, as in src/network/mod.rs."""
    nn, layers, channels = torch.nn, [], 6
    for outputs, kernel, stride in [(64, 5, 2), (128, 5, 2), (256, 3, 2), (512, 3, 2), (1024, 3, 1)]:
        layers += [nn.Conv2d(channels, outputs, kernel, stride, kernel // 2), nn.ReLU(inplace=True), nn.Dropout(0.5)]
        height, width = ((size + 2 * (kernel // 2) - kernel) // stride + 1 for size in (height, width))
        channels = outputs
    features = channels * height * width
    return nn.Sequential(*layers, nn.Flatten(), nn.Linear(features, 128), nn.ReLU(), nn.Linear(128, 6))


def torch_warp(torch, image, depth, intrinsics, pose):
    """Paper Eq. 5 and bilinear interpolation, as in src/warp/mod.rs."""
    batch, _, height, width = image.shape
    fx, fy, cx, cy = intrinsics.view(batch, 4, 1, 1).unbind(1)
    v, u = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    v, u = v.to(image.device), u.to(image.device)
    rays = torch.stack([(u - cx) / fx, (v - cy) / fy, torch.ones_like(u).expand(batch, -1, -1)], 1)
    points = pose[:, :3, :3] @ (rays * depth).flatten(2) + pose[:, :3, 3:]
    x, y, z = points.view(batch, 3, height, width).unbind(1)
    in_front = (z > 1e-3) & (depth[:, 0] > 0)
    z = torch.where(in_front, z, 1.0)
    u, v = x / z * fx + cx, y / z * fy + cy
    valid = in_front & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    grid = torch.stack([u * (2 / (width - 1)) - 1, v * (2 / (height - 1)) - 1], 3)
    sampled = torch.nn.functional.grid_sample(image, grid, padding_mode="border", align_corners=True)
    return sampled * valid[:, None]


def torch_depth_network(torch):
    """Monodepth2 in evaluation mode, its finest disparity alone, as in src/depth/monodepth2."""
    from monodepth2_reference import Decoder, Encoder

    class Disparity(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.encoder, self.decoder = Encoder(), Decoder()

        def forward(self, images):
            return self.decoder(self.encoder(images), scales=[0])[0]

    return Disparity().eval()


def torch_latency(torch, height, width):
    """Decode, resize, warp, network, as Model::predict does it: OpenCV and PyTorch, the depth given."""
    import cv2
    import numpy

    cv2.setNumThreads(int(os.environ["BENCH_THREADS"]))
    files = [numpy.fromfile(name, numpy.uint8) for name in os.environ["RELCOV_BENCH_IMAGES"].split(":")]
    full_height, full_width = cv2.imdecode(files[0], cv2.IMREAD_COLOR).shape[:2]
    scale_x, scale_y = width / full_width, height / full_height
    focal, cx, cy = 0.58 * full_width, 0.5 * full_width, 0.5 * full_height
    intrinsics = torch.tensor([[focal * scale_x, focal * scale_y, (cx + 0.5) * scale_x - 0.5, (cy + 0.5) * scale_y - 0.5]])
    rows = (torch.arange(float(height)) - intrinsics[0, 3]).clamp(min=1e-3)
    depth = (1.65 * intrinsics[0, 1] / rows).clamp(max=80).view(1, 1, height, 1).expand(1, 1, height, width).contiguous()
    pose = torch.tensor([[[1, 0, 0.01, 0.01], [0, 1, 0, 0], [-0.01, 0, 1, 0.9], [0, 0, 0, 1]]])
    layout = torch.channels_last
    network = torch_network(torch, height, width).eval().to(memory_format=layout)

    def read(file):
        image = cv2.resize(cv2.imdecode(file, cv2.IMREAD_COLOR_RGB), (width, height), interpolation=cv2.INTER_AREA)
        return torch.from_numpy(image).permute(2, 0, 1)[None].float().div_(255)

    def run():
        with torch.inference_mode():
            source, target = map(read, files)
            warped = torch_warp(torch, source, depth, intrinsics, pose)
            images = torch.cat([target - 0.5, warped - 0.5], 1).contiguous(memory_format=layout)
            return network(images).double().exp().numpy()

    return run


def open3d_measurement(runs):
    """RGB-D odometry by the colour term: the pair that relcov described in pair.json, from the measured pose on."""
    import numpy
    import open3d

    pair = json.loads((Path(os.environ["RELCOV_BENCH_FOLDER"]) / "pair.json").read_text())
    image = open3d.geometry.Image
    odometry = open3d.pipelines.odometry
    frames = []
    for name, depth in zip(pair["images"], pair["depths"]):
        colour = numpy.asarray(open3d.io.read_image(name), numpy.float32) / 255
        grey = (colour @ numpy.array([0.299, 0.587, 0.114], numpy.float32)).astype(numpy.float32)
        frame = open3d.geometry.RGBDImage()
        frame.color = image(grey)
        frame.depth = image(numpy.asarray(open3d.io.read_image(depth), numpy.float32) / 256)
        frames.append(frame)
    height, width = grey.shape
    camera = open3d.camera.PinholeCameraIntrinsic(width, height, *pair["intrinsics"])
    option = odometry.OdometryOption(open3d.utility.IntVector(ALIGNMENT_ITERATIONS), depth_diff_max=1.0, depth_min=0.0, depth_max=1000.0)
    measured = numpy.array(pair["measured_source_from_target"]).reshape(4, 4)
    jacobian = odometry.RGBDOdometryJacobianFromColorTerm()
    source, target = frames
    # Its "source" is the frame whose points are moved.
    run = lambda: odometry.compute_rgbd_odometry(target, source, camera, measured, jacobian, option)
    success, aligned, _ = run()
    if not success:
        sys.exit("Open3D's odometry failed")
    print(json.dumps({**timed(run, runs), "peak_mb": 0, "before_mb": 0, "version": open3d.__version__,
                      "aligned_source_from_target": numpy.asarray(aligned).flatten().tolist()}))


def timed(run, runs, finish=lambda: None):
    """Times of `run`, ms, after three that do not count."""
    for _ in range(3):
        run()
    times = []
    for _ in range(runs):
        finish()
        begin = time.perf_counter()
        run()
        finish()
        times.append((time.perf_counter() - begin) * 1e3)
    late = sorted(times)[-(-len(times) * 99 // 100) - 1]
    return {"median_ms": statistics.median(times), "least_ms": min(times), "p99_ms": late}


def torch_measurement(mode, height, width, batch, runs, layout, adam, device, precision):
    import torch

    torch.set_num_threads(int(os.environ["BENCH_THREADS"]))
    before = rss_mb()
    finish = torch.cuda.synchronize if device == "cuda" else lambda: None
    # f32 means f32, on a GPU as well.
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    autocast = torch.autocast(device, torch.bfloat16, enabled=precision == "bf16")
    if mode == "latency":
        run = torch_latency(torch, height, width)
    elif mode == "warp":
        image = torch.rand(batch, 3, height, width, device=device)
        rows = torch.arange(float(height), device=device)
        focal_px = 0.58 * width
        depth = (1.65 * focal_px / (rows - height / 2).clamp(min=1)).clamp(max=80)
        depth = depth.view(1, 1, height, 1).expand(batch, 1, height, width).contiguous()
        intrinsics = torch.tensor([focal_px, focal_px, width / 2, height / 2], device=device).repeat(batch, 1)
        pose = torch.tensor([[1, 0, 0.01, 0.01], [0, 1, 0, 0], [-0.01, 0, 1, 0.9], [0, 0, 0, 1]], device=device)
        pose = pose.repeat(batch, 1, 1)

        def run():
            with torch.inference_mode():
                torch_warp(torch, image, depth, intrinsics, pose)
    else:
        network = (torch_depth_network(torch) if mode == "depth" else torch_network(torch, height, width)).to(device)
        images = torch.rand(batch, 3 if mode == "depth" else 6, height, width, device=device)
        if layout == "channels_last":
            network, images = network.to(memory_format=torch.channels_last), images.to(memory_format=torch.channels_last)
        if mode in ("forward", "depth"):
            network.eval()

            def run():
                with torch.inference_mode(), autocast:
                    network(images)
        else:
            network.train()
            optimiser = torch.optim.Adam(network.parameters(), 1e-4, fused=adam == "fused" or None)
            targets = torch.randn(batch, 6, device=device)

            def run():
                optimiser.zero_grad(set_to_none=True)
                with autocast:
                    output = network(images)
                loss = ((output.float() - targets) ** 2).mean()
                loss.backward()
                optimiser.step()
                loss.item()

    measured = timed(run, runs, finish)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({**measured, "peak_mb": peak, "before_mb": before, "version": torch.__version__}))


def rss_mb():
    """Resident memory now, MB; 0 where the system keeps no account."""
    try:
        return int(re.search(r"VmRSS:\s+(\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024
    except (OSError, TypeError):
        return 0.0


# --- Both sides, taking turns -------------------------------------------------------------------


def run_json(command, **environment):
    """The last line a command prints, as JSON."""
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, **environment}, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(f"failed: {' '.join(map(str, command))}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def cores():
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def relcov(binary, mode, height, width, batch, runs, threads=None, device="flex", instructions=""):
    environment = {"RAYON_NUM_THREADS": str(threads or cores()), "RELCOV_BENCH_DEVICE": device, "RELCOV_INSTRUCTIONS": instructions}
    return run_json([binary, mode, *map(str, (height, width, batch, runs))], **environment)


def torch_worker(mode, height, width, batch, runs, threads=None, layout="contiguous", adam="default", device="cpu", precision="f32"):
    command = [sys.executable, __file__, "--worker", mode, *map(str, (height, width, batch, runs)), layout, adam, device, precision]
    return run_json(command, BENCH_THREADS=str(threads or cores()))


def median_of(results):
    """Median of the rounds' medians, and of the memory that each took beyond what it began with."""
    return {
        **results[0],
        "median_ms": statistics.median(result["median_ms"] for result in results),
        "p99_ms": statistics.median(result["p99_ms"] for result in results),
        "memory_mb": statistics.median(result["peak_mb"] - result["before_mb"] for result in results),
    }


LAYOUTS = ["contiguous", "channels_last"]


def side_by_side(binary, case, rounds):
    """relcov, PyTorch ("torch": default Adam, "fused": fused Adam) and Burn's flex, in turn."""
    mode = case[0]
    sides = {("relcov", ""): lambda: relcov(binary, *case), ("stock", ""): lambda: relcov(binary, *case, instructions="burn")}
    for adam in ["default", "fused"] if mode == "train" else ["default"]:
        for layout in LAYOUTS[:1] if mode in ("warp", "latency") else LAYOUTS:
            side = "torch" if adam == "default" else "fused"
            sides[side, layout] = lambda layout=layout, adam=adam: torch_worker(*case, layout=layout, adam=adam)
    return best_of(take_turns(sides, rounds))


def take_turns(sides, rounds):
    results = {side: [] for side in sides}
    for _ in range(rounds):
        for side, measure in sides.items():
            results[side].append(measure())
    return results


def best_of(results):
    """The faster layout of each side."""
    best = {}
    for (side, _), found in results.items():
        found = median_of(found)
        if side not in best or found["median_ms"] < best[side]["median_ms"]:
            best[side] = found
    return best


def build(*options):
    """The benchmark's binary, as cargo names it."""
    command = ["cargo", "bench", "--bench", "peer", "--no-run", "--message-format=json", *options]
    lines = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    artifacts = [json.loads(line) for line in lines if '"compiler-artifact"' in line]
    return next(a["executable"] for a in artifacts if a["target"]["name"] == "peer" and a["executable"])


def processor():
    try:
        return re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text())[1]
    except (OSError, TypeError):
        return platform.processor() or platform.machine()


def ms(value):
    return f"{value:.1f}" if value < 100 else f"{value:.0f}"


def kind(mode):
    return {"train": "train step", "forward": "forward", "warp": "warp", "depth": "depth", "latency": "one covariance"}[mode]


def row(cells):
    return "| " + " | ".join(cells) + " |"


def label(mode, height, width, batch):
    return f"{kind(mode)}, batch {batch}, {height}x{width}"


def main_table(binary, rounds, only):
    heads = ["case", "PyTorch, ms", "PyTorch with fused Adam, ms", "Burn's flex, ms", "relcov, ms", "relcov / PyTorch", "aim",
             "relcov / fused", "memory: PyTorch, MB", "Burn's flex, MB", "relcov, MB"]
    lines = [row(heads), "|---" * len(heads) + "|"]
    version = None
    for *case, aim in CASES:
        name = label(*case[:4])
        if only and only not in name:
            continue
        found = side_by_side(binary, case, rounds)
        ours, torch, stock = found["relcov"], found["torch"], found["stock"]
        fused = found.get("fused")
        version = torch["version"]
        ratio = lambda other: f"{ours['median_ms'] / other['median_ms']:.2f}"
        lines.append(row([
            name, ms(torch["median_ms"]), ms(fused["median_ms"]) if fused else "–", ms(stock["median_ms"]), ms(ours["median_ms"]),
            f"**{ratio(torch)}**", f"{aim:.2f}", ratio(fused) if fused else "–",
            *(f"{side['memory_mb']:.0f}" for side in (fused or torch, stock, ours)),
        ]))
        print(lines[-1], flush=True)
    return lines, version


def depth_table(binary, rounds, only):
    heads = ["case", "PyTorch, ms", "Burn's flex, ms", "relcov, ms", "relcov / PyTorch", "aim", "relcov, ms an image",
             "memory: PyTorch, MB", "Burn's flex, MB", "relcov, MB"]
    lines = [row(heads), "|---" * len(heads) + "|"]
    for *case, aim in DEPTH_CASES:
        if only and only not in label(*case[:4]):
            continue
        found = side_by_side(binary, case, rounds)
        ours, torch, stock = found["relcov"], found["torch"], found["stock"]
        times = [ms(side["median_ms"]) for side in (torch, stock, ours)]
        memory = [f"{side['memory_mb']:.0f}" for side in (torch, stock, ours)]
        ratio = f"**{ours['median_ms'] / torch['median_ms']:.2f}**"
        lines.append(row([label(*case[:4]), *times, ratio, f"{aim:.2f}", ms(ours["median_ms"] / case[3]), *memory]))
        print(lines[-1], flush=True)
    return lines


def latency_table(binary, rounds, images):
    heads = ["case", "PyTorch + OpenCV, ms: median", "99 %", "relcov, ms: median", "99 %", "relcov / peer", "aim", "at 99 %"]
    lines = [row(heads), "|---" * len(heads) + "|"]
    os.environ["RELCOV_BENCH_IMAGES"] = ":".join(images)
    for *case, aim in LATENCY_CASES:
        found = side_by_side(binary, case, rounds)
        ours, torch = found["relcov"], found["torch"]
        numbers = [ms(side[key]) for side in (torch, ours) for key in ("median_ms", "p99_ms")]
        ratios = [ours[key] / torch[key] for key in ("median_ms", "p99_ms")]
        lines.append(row([f"{kind(case[0])}, {case[1]}x{case[2]}", *numbers, f"**{ratios[0]:.2f}**", f"{aim:.2f}", f"{ratios[1]:.2f}"]))
        print(lines[-1], flush=True)
    return lines


def alignment_table(binary, rounds):
    heads = ["case", "Open3D, ms a pair", "relcov, ms a pair", "relcov / Open3D", "aim", "error measured", "left by Open3D", "left by relcov"]
    lines = [row(heads), "|---" * len(heads) + "|"]
    version = None
    with tempfile.TemporaryDirectory() as folder:
        for height, width, pairs, runs, aim in ALIGNMENT_CASES:
            place = Path(folder) / f"{width}x{height}"
            os.environ["RELCOV_BENCH_FOLDER"] = str(place)
            threads = cores() if pairs else 1
            case = ("alignment", height, width, max(pairs, 1), runs)
            peer = [sys.executable, __file__, "--worker", "open3d", "0", "0", "1", str(max(runs // 5, 5))]
            # relcov first: it renders the pair.
            sides = {"relcov": lambda: relcov(binary, *case, threads=threads), "open3d": lambda: run_json(peer, OMP_NUM_THREADS=str(threads))}
            found = {side: median_of(found) for side, found in take_turns(sides, rounds).items()}
            pair = json.loads((place / "pair.json").read_text())
            version = found["open3d"]["version"]
            ours, theirs = found["relcov"]["median_ms"] / max(pairs, 1), found["open3d"]["median_ms"]
            left = [distance(pose, pair["true_source_from_target"]) for pose in
                    (pair["measured_source_from_target"], found["open3d"]["aligned_source_from_target"], pair["aligned_source_from_target"])]
            name = f"{width}x{height}, " + (f"{pairs} pairs on {threads} threads" if pairs else "one pair on one thread")
            lines.append(row([name, f"{theirs:.2f}", f"{ours:.2f}", f"**{ours / theirs:.2f}**", f"{aim:.2f}", *left]))
            print(lines[-1], flush=True)
    return [*lines, "", f"{processor()}, {cores()} cores, {platform.system()}; Open3D {version}; {datetime.date.today().isoformat()}; "
                        f"medians of {rounds} rounds."]


def distance(pose, other):
    """Way and angle between two poses, rows of 4x4 matrices."""
    way = math.dist(pose[3:12:4], other[3:12:4])
    # The trace of the one rotation times the other's transpose; a half sine is exact for small angles.
    half_sine = math.sqrt(sum((pose[k] - other[k]) ** 2 for k in range(12) if k % 4 < 3) / 8)
    return f"{way * 100:.2g} cm, {2000 * math.asin(min(half_sine, 1.0)):.2g} mrad"


def scaling_table(binary, rounds):
    heads = ["case", "threads", "PyTorch (channels last, fused Adam), ms", "relcov, ms", "relcov / PyTorch", "relcov, ms a pair",
             "memory: PyTorch, MB", "relcov, MB"]
    lines = [row(heads), "|---" * len(heads) + "|"]
    for *case, threads in SCALING:
        sides = {"relcov": lambda: relcov(binary, *case, threads=threads),
                 "torch": lambda: torch_worker(*case, threads=threads, layout="channels_last", adam="fused")}
        found = {side: median_of(found) for side, found in take_turns(sides, rounds).items()}
        ours, torch = found["relcov"], found["torch"]
        lines.append(row([
            label(*case[:4]), str(threads or cores()), ms(torch["median_ms"]), ms(ours["median_ms"]),
            f"{ours['median_ms'] / torch['median_ms']:.2f}", ms(ours["median_ms"] / case[3]),
            f"{torch['memory_mb']:.0f}", f"{ours['memory_mb']:.0f}",
        ]))
        print(lines[-1], flush=True)
    return lines


def gpu_table(devices, torch_device, rounds, shape, binary):
    """Training, forward and warp on a GPU: relcov's devices, PyTorch f32 and bf16."""
    binary = binary or build("--features", ",".join(device.split(":")[0] for device in devices))
    heads = ["case", *(f"relcov {device}, ms" for device in devices), "PyTorch f32, ms", "PyTorch bf16, ms"]
    lines = [row(heads), "|---" * len(heads) + "|"]
    for mode, runs in [("train", 10), ("forward", 20), ("warp", 20)]:
        case = (mode, *shape, runs)
        sides = [lambda device=device: relcov(binary, *case, device=device) for device in devices]
        # The warp has no layer that autocast knows.
        sides += [lambda precision=precision: torch_worker(*case, layout="channels_last", adam="fused", device=torch_device, precision=precision)
                  for precision in (["f32"] if mode == "warp" else ["f32", "bf16"])]
        results = [[] for _ in sides]
        for _ in range(rounds):
            for found, side in zip(results, sides):
                found.append(side())
        times = [ms(median_of(found)["median_ms"]) for found in results]
        lines.append(row([label(*case[:4]), *times, *["–"] * (len(devices) + 2 - len(times))]))
        print(lines[-1], flush=True)
    command = f"data_scripts/bench_peer.py --gpu {' '.join(devices)}"
    page = ROOT / "docs" / "results" / "gpu.md"
    page.parent.mkdir(parents=True, exist_ok=True)
    gpu = subprocess.run(["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"], capture_output=True, text=True).stdout.strip() \
        if torch_device == "cuda" else torch_device
    page.write_text("\n".join(["# On a GPU", "", f"`{command}`, {gpu}, {datetime.date.today().isoformat()}.", "", *lines, ""]))


def markers(name):
    return f"<!-- {name}: written by data_scripts/bench_peer.py -->", f"<!-- end of {name} -->"


def check_page(names):
    """Before anything is measured: does the page have a place for each table?"""
    page = PAGE.read_text() if PAGE.exists() else ""
    for marker in (marker for name in names for marker in markers(name)):
        if marker not in page:
            sys.exit(f"{PAGE}: expected the line `{marker}`")


def write_page(tables):
    """Replaces what stands between the markers of docs/performance.md."""
    page = PAGE.read_text()
    for name, lines in tables.items():
        begin, end = markers(name)
        head, rest = page.split(begin)
        page = head + begin + "\n" + "\n".join(lines) + "\n" + end + rest.split(end, 1)[1]
    PAGE.write_text(page)


def main():
    if sys.argv[1:2] == ["--worker"]:
        mode, *numbers = sys.argv[2:7]
        if mode == "open3d":
            return open3d_measurement(int(numbers[3]))
        return torch_measurement(mode, *map(int, numbers), *sys.argv[7:11])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=4, help="turns of each side (default 4)")
    parser.add_argument("--only", help="measure the lines whose name holds this, and print only")
    parser.add_argument("--depth", action="store_true", help="measure the depth network alone")
    parser.add_argument("--latency", action="store_true", help="measure one pair from end to end alone")
    parser.add_argument("--alignment", action="store_true", help="measure the alignment alone (needs open3d)")
    parser.add_argument("--images", nargs=2, help="the two image files of --latency (default: of KITTI's drive 0018)")
    parser.add_argument("--no-scaling", action="store_true", help="leave the scaling table as it is")
    parser.add_argument("--gpu", nargs="+", metavar="DEVICE", help="devices of relcov to compare with PyTorch on a GPU")
    parser.add_argument("--torch-device", default="cuda", choices=["cuda", "cpu"], help="PyTorch's device for --gpu (default cuda)")
    parser.add_argument("--gpu-shape", nargs=3, type=int, default=[160, 512, 84], metavar=("HEIGHT", "WIDTH", "BATCH"),
                        help="for --gpu (default 160 512 84, the size and batch of the paper)")
    parser.add_argument("--binary", help="for --gpu: the benchmark, where it was built elsewhere (cargo bench --bench peer --no-run)")
    arguments = parser.parse_args()
    if arguments.gpu:
        return gpu_table(arguments.gpu, arguments.torch_device, arguments.rounds, arguments.gpu_shape, arguments.binary)
    if not arguments.only:
        check_page(["machine", "comparison", "scaling", "depth", "latency", "alignment"])
    has_open3d = importlib.util.find_spec("open3d") is not None
    if arguments.alignment:
        if not has_open3d:
            sys.exit("Open3D is not installed: uv run --with open3d data_scripts/bench_peer.py --alignment, or pip install open3d")
        return write_page({"alignment": alignment_table(build(), arguments.rounds)})
    images = arguments.images or [str((ROOT / LATENCY_IMAGES.format(frame)).resolve()) for frame in range(2)]
    if not arguments.only and (missing := [name for name in images if not Path(name).is_file()]):
        sys.exit(f"{missing[0]}: no such file; --images names two JPEG files for --latency")
    binary = build()
    if arguments.latency:
        return write_page({"latency": latency_table(binary, arguments.rounds, images)})
    depth_lines = depth_table(binary, arguments.rounds, arguments.only)
    if arguments.depth:
        return None if arguments.only else write_page({"depth": depth_lines})
    main_lines, version = main_table(binary, arguments.rounds, arguments.only)
    if arguments.only:
        return
    tables = {"comparison": main_lines, "depth": depth_lines, "latency": latency_table(binary, arguments.rounds, images)}
    scaling_rounds = max(1, arguments.rounds // 2)
    if has_open3d:
        tables["alignment"] = alignment_table(binary, arguments.rounds)
    else:
        print("Open3D is not installed: the alignment's table stays as it is", file=sys.stderr)
    if not arguments.no_scaling:
        tables["scaling"] = scaling_table(binary, scaling_rounds)
    tables["machine"] = [
        f"{processor()}, {cores()} cores, {platform.system()}; PyTorch {version}, "
        f"relcov {json.loads(subprocess.check_output(['cargo', 'metadata', '--no-deps', '--format-version=1'], cwd=ROOT))['packages'][0]['version']}; "
        f"{datetime.date.today().isoformat()}. Medians of {arguments.rounds} rounds (scaling: {scaling_rounds}); memory is the peak over that before the network was built."
    ]
    write_page(tables)


if __name__ == "__main__":
    main()
