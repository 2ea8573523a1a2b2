//! That this processor, and every device, computes a convolution as its definition says: for `relcov doctor`.

use burn::tensor::ops::ConvOptions;
use burn::tensor::{Device, Tensor, TensorData, module};

use super::convolution::{convolution, input_gradient, weight_gradient};
use super::instructions::Instructions;
use super::reference::{Reference, deviation, noise, reference};
use super::shape::ConvolutionShape;

/// One that fills no vector and no tile evenly.
const SHAPE: ConvolutionShape = ConvolutionShape {
    batch: 2,
    inputs: 7,
    outputs: 19,
    size: [13, 37],
    kernel: [3, 5],
    stride: [2, 1],
    padding: [1, 2],
};

struct Case {
    input: Vec<f32>,
    weight: Vec<f32>,
    gradient: Vec<f32>,
    expected: Reference,
}

impl Case {
    fn new() -> Self {
        let [input, weight, gradient] = [(SHAPE.input_len(), 1), (SHAPE.weight_len(), 2), (SHAPE.output_len(), 3)]
            .map(|(len, seed)| noise(len, seed));
        let expected = reference(SHAPE, &input, &weight, &gradient);
        Self { input, weight, gradient, expected }
    }

    fn deviation(&self, output: &[f32], input_gradient: &[f32], weight_gradient: &[f32]) -> f64 {
        deviation(output, &self.expected.output)
            .max(deviation(input_gradient, &self.expected.input_gradient))
            .max(deviation(weight_gradient, &self.expected.weight_gradient))
    }
}

/// How far these instructions' convolution and its gradients lie from the definition, as shares of the sums of their
/// terms' sizes: below 1e-6 where all is well.
pub(crate) fn deviation_by(instructions: Instructions) -> f64 {
    let case = Case::new();
    case.deviation(
        &convolution(instructions, SHAPE, &case.input, &case.weight, None),
        &input_gradient(instructions, SHAPE, &case.weight, &case.gradient),
        &weight_gradient(instructions, SHAPE, &case.input, &case.gradient),
    )
}

/// The same of Burn's own operations on a device, through its automatic differentiation.
pub(crate) fn deviation_on(device: &Device) -> f64 {
    let case = Case::new();
    let device = device.clone().autodiff();
    let tensor =
        |values: &[f32], shape: [usize; 4]| Tensor::<4>::from_data(TensorData::new(values.to_vec(), shape), &device);
    let ([rows, columns], [height, width], [kernel_rows, kernel_columns]) =
        (SHAPE.output_size(), SHAPE.size, SHAPE.kernel);
    let input = tensor(&case.input, [SHAPE.batch, SHAPE.inputs, height, width]).require_grad();
    let weight = tensor(&case.weight, [SHAPE.outputs, SHAPE.inputs, kernel_rows, kernel_columns]).require_grad();
    let gradient = tensor(&case.gradient, [SHAPE.batch, SHAPE.outputs, rows, columns]);
    let options = ConvOptions::new(SHAPE.stride, SHAPE.padding, [1, 1], 1);
    let output = module::conv2d(input.clone(), weight.clone(), None, options);
    let gradients = (output.clone() * gradient).sum().backward();
    let values = |tensor: Tensor<4>| tensor.into_data().iter::<f32>().collect::<Vec<_>>();
    let gradient_of = |tensor: &Tensor<4>| tensor.grad(&gradients).map(values).unwrap_or_default();
    case.deviation(&values(output), &gradient_of(&input), &gradient_of(&weight))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_case_agrees_by_all_instructions() {
        for instructions in Instructions::available() {
            assert!(deviation_by(instructions) < 1e-6, "{}", instructions.name());
        }
    }

    #[test]
    fn what_is_wrong_is_seen() {
        let case = Case::new();
        let [mut output, input_gradient, weight_gradient] =
            [&case.expected.output, &case.expected.input_gradient, &case.expected.weight_gradient]
                .map(|values| values.iter().map(|value| value[0] as f32).collect::<Vec<_>>());
        assert!(case.deviation(&output, &input_gradient, &weight_gradient) < 1e-6);
        output[5] += 1e-3;
        assert!(case.deviation(&output, &input_gradient, &weight_gradient) > 1e-6);
        output[5] = f32::NAN;
        assert_eq!(case.deviation(&output, &input_gradient, &weight_gradient), f64::INFINITY);
    }
}
