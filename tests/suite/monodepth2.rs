//! The depth network against PyTorch's.

use std::path::{Path, PathBuf};

use burn::tensor::{Device, Tensor, TensorData};
use relcov::depth::monodepth2::PublishedWeights;
use relcov::recordings::read_image;
use safetensors::SafeTensors;

use crate::support::device;

/// Reference weights, image and disparities: those kept with the tests, or those of
/// `data_scripts/monodepth2_reference.py --out DIR`.
fn reference() -> PathBuf {
    std::env::var_os("RELCOV_MONODEPTH2_REFERENCE")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/monodepth2"), PathBuf::from)
}

fn floats(tensors: &SafeTensors, name: &str) -> Vec<f32> {
    let (values, _) = tensors.tensor(name).unwrap().data().as_chunks::<4>();
    values.iter().map(|&value| f32::from_le_bytes(value)).collect()
}

/// Off flex the network is Burn's own operations.
#[test]
fn disparities_are_the_same_on_every_backend() {
    let disparity = |device: &Device| -> Vec<f32> {
        let PublishedWeights { network, width, height, .. } = PublishedWeights::load(&reference(), device).unwrap();
        let image = read_image(&reference().join("image.png")).unwrap().resized_sharply(width, height);
        let mut planes = Vec::new();
        image.extend_planar(&mut planes);
        let images = Tensor::from_data(TensorData::new(planes, [1, 3, height, width]), device);
        network.disparity(images).into_data().iter().collect()
    };
    let flex = disparity(&Device::flex());
    for name in ["ndarray", "wgpu"] {
        let Some(device) = device(name) else { continue };
        let worst = disparity(&device).iter().zip(&flex).map(|(a, b)| (a - b).abs() / b).fold(0.0, f32::max);
        eprintln!("{name}: worst relative difference from flex {worst:.1e}");
        assert!(worst <= 1e-4, "{name}: {worst:e}");
    }
}

#[test]
fn disparities_are_those_of_pytorch() {
    let folder = reference();
    let bytes = std::fs::read(folder.join("reference.safetensors")).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let device = Device::flex();
    let PublishedWeights { network, width, height, stereo } = PublishedWeights::load(&folder, &device).unwrap();
    assert!(!stereo);

    let pixels = tensors.tensor("pixels").unwrap();
    assert_eq!(pixels.shape(), [height, width, 3]);
    let resized = read_image(&folder.join("image.png")).unwrap().resized_sharply(width, height);
    let levels: Vec<u8> = resized.bytes.iter().zip(pixels.data()).map(|(&a, &b)| a.abs_diff(b)).collect();
    let different = levels.iter().filter(|&&levels| levels > 0).count() as f64 / levels.len() as f64;
    eprintln!("Lanczos: {:.2} % of values differ from Pillow's", 100.0 * different);
    assert!(levels.iter().all(|&levels| levels <= 1) && different < 0.01, "{different}");

    let planes: Vec<f32> = (0..3)
        .flat_map(|channel| pixels.data()[channel..].iter().step_by(3))
        .map(|&byte| f32::from(byte) / 255.0)
        .collect();
    let images = Tensor::from_data(TensorData::new(planes, [1, 3, height, width]), &device);
    for (scale, disparity) in network.forward(images).into_iter().enumerate() {
        assert_eq!(disparity.dims(), [1, 1, height >> scale, width >> scale]);
        let found: Vec<f32> = disparity.into_data().iter().collect();
        let expected = floats(&tensors, &format!("disparity_{scale}"));
        let relative = found.iter().zip(&expected).map(|(found, expected)| (found - expected).abs() / expected);
        let worst = relative.fold(0.0, f32::max);
        eprintln!("scale {scale}: worst relative difference {worst:.1e}");
        assert!(worst <= 1e-4, "scale {scale}: {worst:e}");
    }
}
