//! Convolution and gradients as their definition says, in f64: what the kernels and every device are compared with.

use super::shape::ConvolutionShape;

/// Output, gradient of the input and gradient of the weights, each beside the sum of the sizes of its
/// terms, which bounds what f32 may round away.
pub(super) struct Reference {
    pub output: Vec<[f64; 2]>,
    pub input_gradient: Vec<[f64; 2]>,
    pub weight_gradient: Vec<[f64; 2]>,
}

pub(super) fn reference(shape: ConvolutionShape, input: &[f32], weight: &[f32], gradient: &[f32]) -> Reference {
    let [rows, columns] = shape.output_size();
    let mut result = Reference {
        output: vec![[0.0; 2]; shape.output_len()],
        input_gradient: vec![[0.0; 2]; shape.input_len()],
        weight_gradient: vec![[0.0; 2]; shape.weight_len()],
    };
    let add = |sum: &mut [f64; 2], a: f32, b: f32| {
        let term = f64::from(a) * f64::from(b);
        sum[0] += term;
        sum[1] += term.abs();
    };
    for (o, value) in (0..shape.output_len()).zip(gradient) {
        let (image, rest) = (o / (shape.outputs * rows * columns), o % (shape.outputs * rows * columns));
        let (output, pixel) = (rest / (rows * columns), rest % (rows * columns));
        for w in 0..shape.inputs * shape.kernel[0] * shape.kernel[1] {
            let (channel, tap) = (w / (shape.kernel[0] * shape.kernel[1]), w % (shape.kernel[0] * shape.kernel[1]));
            let v = (pixel / columns * shape.stride[0] + tap / shape.kernel[1]).checked_sub(shape.padding[0]);
            let u = (pixel % columns * shape.stride[1] + tap % shape.kernel[1]).checked_sub(shape.padding[1]);
            let (Some(v), Some(u)) = (v, u) else { continue };
            if v >= shape.size[0] || u >= shape.size[1] {
                continue;
            }
            let i = ((image * shape.inputs + channel) * shape.size[0] + v) * shape.size[1] + u;
            let w = output * shape.inputs * shape.kernel[0] * shape.kernel[1] + w;
            add(&mut result.output[o], input[i], weight[w]);
            add(&mut result.input_gradient[i], *value, weight[w]);
            add(&mut result.weight_gradient[w], *value, input[i]);
        }
    }
    result
}

/// Largest distance of values from the definition, each as a share of what its terms sum up to without their signs:
/// a few 1e-7 where sums are rounded to f32, infinite where one is no number.
pub(super) fn deviation(found: &[f32], expected: &[[f64; 2]]) -> f64 {
    assert_eq!(found.len(), expected.len(), "one value each");
    let share = |(&found, &[sum, size]): (&f32, &[f64; 2])| match (f64::from(found) - sum).abs() / (size + 1e-6) {
        share if share.is_nan() => f64::INFINITY,
        share => share,
    };
    found.iter().zip(expected).map(share).fold(0.0, f64::max)
}

/// Values in −0.5…0.5 that differ from place to place.
pub(super) fn noise(len: usize, seed: u32) -> Vec<f32> {
    let value = |index: u32| index.wrapping_add(seed).wrapping_mul(0x9E37_79B9);
    (0..len as u32).map(|index| (value(value(index)) >> 8) as f32 / 16_777_216.0 - 0.5).collect()
}
