#!/usr/bin/env -S uv run --script
# /// script
# requires-python = ">=3.10"
# dependencies = ["numpy", "scipy", "uncertainty-toolbox==0.1.1", "arch==8.0.0"]
# ///
"""Judges random predictions with relcov and with scipy, uncertainty-toolbox, arch and numpy, and compares scores,
block lengths and an interval.

    cargo build --release && uv run data_scripts/check_metrics.py

Without uv: pip install numpy scipy uncertainty-toolbox arch, then run it with python.
Exits with 1 and names the scores that differ. `--measure 100000` prints time and memory of judging so many
pairs with full covariances instead.
"""

import argparse
import csv
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy
import scipy.linalg
import scipy.stats
import uncertainty_toolbox
from arch.bootstrap import optimal_block_length

ROOT = Path(__file__).resolve().parent.parent
COMPONENTS = ["x", "y", "z", "roll", "pitch", "yaw"]
PAIRS = 1500
LARGEST_DIFFERENCE = 1e-9

failures = 0
compared = 0


def compare(name, found, expected, tolerance=LARGEST_DIFFERENCE):
    global failures, compared
    found, expected = numpy.asarray(found, float), numpy.asarray(expected, float)
    off = numpy.max(numpy.abs(found - expected) / numpy.maximum(numpy.abs(expected), 1e-12))
    compared += found.size
    if not off <= tolerance:
        failures += 1
        print(f"{name}: relcov {found}, expected {expected}", file=sys.stderr)


def random_table(random, pairs, full):
    """Errors with their own covariance times a factor, correlated in time; covariances that vary tenfold."""
    scale = numpy.array([0.05, 0.02, 0.03, 1e-3, 2e-3, 8e-4])
    noise = numpy.zeros(6)
    errors, covariances = [], []
    for _ in range(pairs):
        sigma = scale * numpy.exp(random.normal(0, 0.6, 6))
        lower = numpy.eye(6) + (numpy.tril(random.normal(0, 0.4, (6, 6)), -1) if full else 0)
        factor = numpy.diag(sigma) @ lower
        noise = 0.8 * noise + 0.6 * random.normal(size=6)
        errors.append(1.2 * factor @ noise)
        covariances.append(factor @ factor.T)
    return numpy.array(errors), numpy.array(covariances)


def pose(tangent):
    generator = numpy.zeros((4, 4))
    x, y, z = tangent[3:]
    generator[:3] = numpy.array([[0, -z, y, tangent[0]], [z, 0, -x, tangent[1]], [-y, x, 0, tangent[2]]])
    return scipy.linalg.expm(generator)


def tangent(pose):
    generator = scipy.linalg.logm(pose).real
    return numpy.array([*generator[:3, 3], generator[2, 1], generator[0, 2], generator[1, 0]])


def corrected(errors, corrections):
    return numpy.array([tangent(pose(-m) @ pose(e)) for m, e in zip(corrections, errors)])


def write(path, errors, covariances, full, motions, corrections=None):
    """With corrections the covariances are those of what they leave of the errors."""
    above = [(i, j) for i in range(6) for j in range(i + 1, 6)]
    upper = [(i, j) for i in range(6) for j in range(i, 6)]
    left = covariances
    if corrections is not None:
        covariances, full = left + corrections[:, :, None] * corrections[:, None, :], True
    header = ["system", "drive", "source", "target"]
    header += [f"motion_{c}" for c in COMPONENTS] + [f"error_{c}" for c in COMPONENTS]
    header += [f"variance_{c}" for c in COMPONENTS]
    header += [f"covariance_{COMPONENTS[i]}_{COMPONENTS[j]}" for i, j in above] if full else []
    if corrections is not None:
        header += [f"correction_{c}" for c in COMPONENTS]
        header += [f"corrected_{COMPONENTS[i]}_{COMPONENTS[j]}" for i, j in upper]
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for index, (motion, error, covariance) in enumerate(zip(motions, errors, covariances)):
            row = ["vo", f"drive_{3 * index // len(errors)}", index, index + 1, *map(repr, map(float, motion))]
            row += [repr(float(value)) for value in (*error, *numpy.diag(covariance))]
            row += [repr(float(covariance[i, j])) for i, j in above] if full else []
            if corrections is not None:
                row += [repr(float(value)) for value in corrections[index]]
                row += [repr(float(left[index][i, j])) for i, j in upper]
            writer.writerow(row)


def sparsification(key, sizes):
    order = numpy.argsort(-key, kind="stable")
    left = [sizes[order[index:]].mean() for index in range(len(order))]
    return numpy.array(left) / sizes.mean()


def bins_by(key):
    order = numpy.argsort(key, kind="stable")
    edges = [k * len(order) // 10 for k in range(11)]
    return [order[first:end] for first, end in zip(edges, edges[1:])]


def check_bins(name, found, log_sigma, normalised):
    bins = bins_by(log_sigma)
    compare(f"{name} sigma of bins", found["sigma"], [numpy.exp(numpy.mean(log_sigma[b])) for b in bins])
    compare(f"{name} normalised errors of bins", found["anees"], [numpy.mean(normalised[b]) for b in bins], 1e-8)


def check_method(name, metrics, errors, covariances):
    variance = numpy.einsum("nii->ni", covariances)
    sigma, sizes = numpy.sqrt(variance), numpy.abs(errors)
    dispersion = numpy.sqrt(numpy.abs(variance - errors**2))
    compare(f"{name} mde", metrics["mde"], numpy.median(dispersion, axis=0))
    compare(f"{name} de_quartiles", metrics["de_quartiles"], numpy.quantile(dispersion, [0.25, 0.5, 0.75], axis=0))
    likelihood = [scipy.stats.multivariate_normal(cov=c).logpdf(e) for c, e in zip(covariances, errors)]
    compare(f"{name} nll", metrics["nll"], -numpy.mean(likelihood))
    nees = numpy.array([e @ numpy.linalg.solve(c, e) for c, e in zip(covariances, errors)])
    compare(f"{name} anees", metrics["anees"], nees.mean() / 6, 1e-8)
    compare(f"{name} nees_below_95", metrics["nees_below_95"], numpy.mean(nees < scipy.stats.chi2(6).ppf(0.95)), 1e-3)
    z = errors / sigma
    compare(f"{name} zms", metrics["zms"], numpy.mean(z**2, axis=0))
    compare(f"{name} coverage", metrics["coverage"], [numpy.mean(numpy.abs(z) <= k, axis=0) for k in (1, 2, 3)])
    compare(f"{name} sharpness", metrics["sharpness"], sigma.mean(axis=0))
    moves = bool(numpy.ptp(sigma, axis=0).any())
    compare(f"{name} has conditional calibration", metrics.get("conditional") is not None, moves)
    if moves:
        check_bins(f"{name} joint", metrics["conditional"]["joint"], numpy.linalg.slogdet(covariances)[1] / 12, nees / 6)
        for c, found in enumerate(metrics["conditional"]["by_component"]):
            check_bins(f"{name} {COMPONENTS[c]}", found, numpy.log(sigma[:, c]), z[:, c] ** 2)
    for c in range(6):
        zeros, s, e = numpy.zeros(len(errors)), sigma[:, c], errors[:, c]
        label = f"{name} {COMPONENTS[c]}"
        compare(f"{label} crps", metrics["crps"][c], uncertainty_toolbox.metrics.crps_gaussian(zeros, s, e))
        compare(f"{label} nll", metrics["nll_by_component"][c], uncertainty_toolbox.metrics.nll_gaussian(zeros, s, e))
        by_error = sparsification(sizes[:, c], sizes[:, c])
        if numpy.ptp(s) == 0:
            # Equal sigmas have no order: one bin, and a random order's expected curve.
            rmse = numpy.sqrt(numpy.mean(e**2))
            compare(f"{label} spearman", metrics["spearman"][c] is None, True)
            compare(f"{label} ence", metrics["ence"][c], abs(s[0] - rmse) / s[0])
            compare(f"{label} ause", metrics["ause"][c], numpy.mean(1 - by_error))
            compare(f"{label} aurg", metrics["aurg"][c] + 1, 1)
            continue
        compare(f"{label} spearman", metrics["spearman"][c], scipy.stats.spearmanr(sizes[:, c], s).statistic)
        bins = bins_by(s)
        rmv = numpy.array([numpy.sqrt(numpy.mean(s[b] ** 2)) for b in bins])
        rmse = numpy.array([numpy.sqrt(numpy.mean(e[b] ** 2)) for b in bins])
        compare(f"{label} ence", metrics["ence"][c], numpy.mean(numpy.abs(rmv - rmse) / rmv))
        by_sigma = sparsification(s, sizes[:, c])
        compare(f"{label} ause", metrics["ause"][c], numpy.mean(by_sigma - by_error))
        compare(f"{label} aurg", metrics["aurg"][c], numpy.mean(1 - by_sigma))


def check(relcov, folder, full, seed):
    random = numpy.random.default_rng(seed)
    motions = random.normal(0, [0.5, 0.02, 0.02, 0.01, 0.02, 0.03], (PAIRS, 6))
    errors, covariances = random_table(random, PAIRS, full)
    training_errors, training_covariances = random_table(random, 900, full)
    write(folder / "mine.csv", errors, covariances, full, motions)
    write(folder / "training.csv", training_errors, training_covariances, full, motions[:900])
    command = [relcov, "eval", "--quiet", "--error-frame", "vehicle", "--pairs", folder / "mine.csv"]
    command += ["--fit", folder / "training.csv", "--save-results", folder / "mine_scores.json"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    system = json.loads((folder / "mine_scores.json").read_text())["systems"]["vo"]

    kind = "full" if full else "diagonal"
    check_method(kind, system["methods"]["mine"], errors, covariances)
    constant = numpy.mean(training_errors**2, axis=0)
    mad = scipy.stats.median_abs_deviation(training_errors, axis=0, center=lambda *_, **__: 0, scale="normal") ** 2
    for method, variance in (("constant", constant), ("constant_mad", mad)):
        check_method(f"{kind} {method}", system["methods"][method], errors, numpy.tile(numpy.diag(variance), (PAIRS, 1, 1)))
    compare(f"{kind} zero crps", system["methods"]["zero"]["crps"], numpy.mean(numpy.abs(errors), axis=0))

    # The block length: arch normalises autocorrelations a little differently at long lags.
    lengths = [optimal_block_length(errors[:, c] ** 2)["circular"].iloc[0] for c in range(6)]
    compare(f"{kind} block length", system["bootstrap"]["block_length"], numpy.ceil(max(1, *lengths)), 0.1)
    # The interval: a plain block bootstrap in numpy with as many resamples, so equal up to their noise.
    nees = numpy.array([e @ numpy.linalg.solve(c, e) for c, e in zip(covariances, errors)]) / 6
    length = system["bootstrap"]["block_length"]
    starts = random.integers(0, PAIRS, (4000, -(-PAIRS // length)))
    rows = (starts[:, :, None] + numpy.arange(length)).reshape(4000, -1)[:, :PAIRS] % PAIRS
    expected = numpy.quantile(nees[rows].mean(axis=1), [0.025, 0.975])
    width = expected[1] - expected[0]
    off = numpy.abs(numpy.array(system["methods"]["mine"]["anees_interval"]) - expected) / width
    compare(f"{kind} interval of ANEES, in its width", 1 + off, [1, 1], 0.12)


def check_corrected(relcov, folder, seed):
    """Most of each error is predicted, and what is left judged by its own covariance."""
    random = numpy.random.default_rng(seed)
    motions = random.normal(0, [0.5, 0.02, 0.02, 0.01, 0.02, 0.03], (PAIRS, 6))
    left, covariances = random_table(random, PAIRS, full=True)
    corrections = random.normal(0, 3, (PAIRS, 6)) * numpy.std(left, axis=0)
    errors = corrections + left
    write(folder / "seen.csv", errors, covariances, True, motions, corrections)
    command = [relcov, "eval", "--quiet", "--error-frame", "vehicle", "--pairs", folder / "seen.csv"]
    command += ["--save-results", folder / "seen_scores.json"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    methods = json.loads((folder / "seen_scores.json").read_text())["systems"]["vo"]["methods"]
    check_method("seen", methods["seen"], errors, covariances + corrections[:, :, None] * corrections[:, None, :])
    remaining, metrics = corrected(errors, corrections), methods["seen_corrected"]
    check_method("corrected", metrics, remaining, covariances)
    ratios, rms = metrics["rms_ratio"], lambda values: numpy.sqrt(numpy.mean(values**2, axis=0))
    compare("corrected rms_ratio", ratios["components"], rms(remaining) / rms(errors))
    for part, columns in (("translation", slice(0, 3)), ("rotation", slice(3, 6))):
        sizes = [numpy.linalg.norm(values[:, columns], axis=1) for values in (remaining, errors)]
        compare(f"corrected rms_ratio of {part}", ratios[part], rms(sizes[0]) / rms(sizes[1]))


def measure(relcov, folder, pairs):
    random = numpy.random.default_rng(7)
    errors, covariances = random_table(random, pairs, full=True)
    write(folder / "mine.csv", errors, covariances, True, random.normal(0, 0.5, (pairs, 6)))
    command = [relcov, "eval", "--quiet", "--error-frame", "vehicle", "--pairs", folder / "mine.csv"]
    command += ["--fit", folder / "mine.csv", "--save-results", folder / "scores.json", "--save-plot", folder / "figures"]
    begin = time.time()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    seconds, peak = time.time() - begin, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    size = (folder / "mine.csv").stat().st_size / 1e6
    print(f"{pairs} pairs ({size:.0f} MB, read twice), scores, figures and results: {seconds:.1f} s, {peak:.0f} MiB")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--relcov", default=ROOT / "target/release/relcov", help="the program [default: %(default)s]")
    parser.add_argument("--measure", type=int, metavar="PAIRS", help="measure time and memory of so many pairs")
    arguments = parser.parse_args()
    if arguments.measure:
        with tempfile.TemporaryDirectory() as folder:
            measure(arguments.relcov, Path(folder), arguments.measure)
        return
    for full in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            check(arguments.relcov, Path(folder), full, seed=7)
    with tempfile.TemporaryDirectory() as folder:
        check_corrected(arguments.relcov, Path(folder), seed=8)
    print(f"{compared} numbers compared, {failures} scores differ")
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
