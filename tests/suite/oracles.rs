//! Numbers computed independently, at 60 digits or in other programs.

use burn::tensor::{Device, Tensor, TensorData};
use relcov::geometry::{Covariance6, Pose, Tangent};
use relcov::loss::gaussian_loss;
use relcov::network::{CovarianceNetworkConfig, NetworkInput};
use relcov::warp::Warp;
use safetensors::SafeTensors;
use serde_json::Value;

use crate::support::{pose_from_rows, shared};

fn json(name: &str) -> Option<Value> {
    let path = shared(&format!("oracles/{name}.json"))?;
    Some(serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap())
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

/// A tensor of f64 from a safetensors file, as f32 on a device.
fn tensor<const D: usize>(file: &SafeTensors, name: &str, device: &Device) -> Tensor<D> {
    let view = file.tensor(name).unwrap();
    let values: Vec<f32> =
        view.data().chunks_exact(8).map(|bytes| f64::from_le_bytes(bytes.try_into().unwrap()) as f32).collect();
    Tensor::from_data(TensorData::new(values, view.shape().to_vec()), device)
}

fn largest<const D: usize>(tensor: Tensor<D>) -> f32 {
    tensor.abs().max().into_scalar::<f32>()
}

#[test]
fn exponential_and_logarithm_agree_with_sixty_digits() {
    let Some(oracle) = json("se3") else { return };
    for case in oracle["exp"].as_array().unwrap() {
        let tangent = Tangent::from_column_slice(&numbers(&case["xi"]));
        let angle = tangent.fixed_rows::<3>(3).norm();
        let expected = nalgebra::Matrix4::from_row_slice(&numbers(&case["T"]));
        let exp = Pose::exp(&tangent).matrix();
        let error = (exp - expected).norm() / expected.norm();
        assert!(error <= 1e-9, "exp at angle {angle}: {error:e}");

        let tolerance = if (angle - std::f64::consts::PI).abs() < 1e-6 { 1e-6 } else { 1e-9 };
        let log = pose_from_rows(expected.transpose().as_slice()).log();
        let error = (log - tangent).norm();
        assert!(error <= tolerance * tangent.norm(), "log at angle {angle}: {error:e} of {:e}", tangent.norm());
    }
}

#[test]
fn pose_errors_agree_with_sixty_digits() {
    let Some(oracle) = json("se3") else { return };
    for case in oracle["error"].as_array().unwrap() {
        let truth = pose_from_rows(&numbers(&case["truth"]));
        let measured = pose_from_rows(&numbers(&case["measured"]));
        let expected = Tangent::from_column_slice(&numbers(&case["e"]));
        let error = (Pose::error(&measured, &truth) - expected).norm();
        assert!(error <= 1e-9 * expected.norm().max(1.0), "{error:e}");
    }
}

#[test]
fn the_warp_agrees_with_an_independent_one() {
    let Some(path) = shared("oracles/warp.safetensors") else { return };
    let bytes = std::fs::read(path).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let device = Device::flex();
    let intrinsics: Tensor<3> = tensor(&file, "intrinsics", &device);
    let [batch, ..] = intrinsics.dims();
    let entry = |row: usize, column: usize| {
        intrinsics.clone().slice([0..batch, row..row + 1, column..column + 1]).reshape([batch, 1])
    };
    let intrinsics = Tensor::cat(vec![entry(0, 0), entry(1, 1), entry(0, 2), entry(1, 2)], 1);

    let coordinates =
        Warp.project(tensor(&file, "depth", &device), intrinsics, tensor(&file, "source_from_target", &device));
    let expected_valid: Tensor<4> = tensor(&file, "valid", &device);
    let expected: Tensor<4> = tensor(&file, "coordinates", &device);
    let [_, _, height, width] = expected_valid.dims();
    // The first pose is the identity: there the oracle's border pixels are in or out by f64 rounding.
    let last = Tensor::<1>::from_floats([(width - 1) as f32, (height - 1) as f32], &device).reshape([1, 2, 1, 1]);
    let from_border = expected.clone().abs().min_pair((expected.clone() - last).abs()).min_dim(1);
    let clear_of_border = from_border.greater_elem(2e-3).float();
    assert!(clear_of_border.clone().mean().into_scalar::<f32>() > 0.9);
    let differs = (coordinates.valid.clone().float() - expected_valid.clone()) * clear_of_border;
    assert_eq!(largest(differs), 0.0, "validity");

    let uv = Tensor::cat(vec![coordinates.u.clone(), coordinates.v.clone()], 1);
    let off_px = largest((uv - expected) * expected_valid.clone());
    assert!(off_px <= 1e-3, "coordinates are off by {off_px} px");

    let warped = Warp.sample(tensor(&file, "source", &device), coordinates);
    let expected: Tensor<4> = tensor(&file, "warped_border", &device);
    let off = largest((warped.image - expected) * expected_valid);
    assert!(off <= 1e-4, "warped image is off by {off}");
}

#[test]
fn network_and_loss_agree_with_an_independent_one() {
    let Some(path) = shared("oracles/covnet.safetensors") else { return };
    let oracle = json("covnet").unwrap();
    let bytes = std::fs::read(path).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let device = Device::flex();
    let input: Tensor<4> = tensor(&file, "input", &device);
    let [_, channels, height, width] = input.dims();
    let network = CovarianceNetworkConfig::table_one(channels, height, width).init([0.0; 6], &device);
    let network = crate::support::with_formula_weights(network);

    for (layer, activation) in network.features(input.clone()).into_iter().enumerate() {
        let mean = activation.mean().into_scalar::<f32>();
        let expected = oracle["activations"][format!("c{}_mean", layer + 1)].as_f64().unwrap();
        assert!((f64::from(mean) - expected).abs() <= 1e-4 * expected, "c{}: {mean} against {expected}", layer + 1);
    }
    let d = network.forward(NetworkInput { images: Some(input), ..NetworkInput::default() });
    let expected_d: Tensor<2> = tensor(&file, "d", &device);
    let relative = largest(d.clone() - expected_d.clone()) / largest(expected_d.clone());
    assert!(relative <= 1e-4, "d is off by {relative}");
    let loss = gaussian_loss(d, tensor(&file, "error", &device));
    let expected: Tensor<1> = tensor(&file, "loss", &device);
    let relative = largest((loss - expected.clone()) / expected);
    assert!(relative <= 1e-4, "loss is off by {relative}");
}

#[test]
fn metrics_agree_with_an_independent_program() {
    let Some(oracle) = json("metrics") else { return };
    let rows = |key: &str| -> Vec<[f64; 6]> {
        oracle[key].as_array().unwrap().iter().map(|row| numbers(row).try_into().unwrap()).collect()
    };
    let covariance = |variance: [f64; 6]| Covariance6::from_variances(&variance.into());
    let covariances: Vec<Covariance6> = rows("variance").into_iter().map(covariance).collect();
    let metrics = relcov::evaluation::evaluate(&covariances, &rows("error"), None).unwrap();
    let close = |name: &str, value: f64, expected: f64| {
        assert!((value - expected).abs() <= 1e-9 * expected.abs().max(1.0), "{name}: {value} against {expected}");
    };
    close("nll", metrics.nll.unwrap(), oracle["nll6_mean"].as_f64().unwrap());
    close("anees", metrics.anees.unwrap(), oracle["anees"].as_f64().unwrap());
    close("nees below", metrics.nees_below_95.unwrap(), oracle["nees_below_12.592"].as_f64().unwrap());
    let mde = numbers(&oracle["mde"]);
    let coverage = metrics.coverage.unwrap();
    for c in 0..6 {
        close("mde", metrics.mde[c], mde[c]);
        close("crps", metrics.crps.unwrap()[c], numbers(&oracle["crps_mean"])[c]);
        close("spearman", metrics.spearman[c].unwrap(), numbers(&oracle["spearman"])[c]);
        close("first quartile", metrics.de_quartiles[0][c], numbers(&oracle["de_quartiles"][0])[c]);
        close("third quartile", metrics.de_quartiles[2][c], numbers(&oracle["de_quartiles"][1])[c]);
        for sigmas in 0..3 {
            close("coverage", coverage[sigmas][c], numbers(&oracle["coverage_1_2_3_sigma"][sigmas])[c]);
        }
    }
}
