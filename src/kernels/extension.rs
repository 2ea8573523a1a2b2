//! The kernels as operations of Burn's flex backend, and their gradients.

use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::flex::{FlexTensor, Layout};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, ExtensionType, Flex, TensorMetadata, backend_extension};
use burn::tensor::{Bytes, DType, Shape};

use super::activation::{self, DropoutRate};
use super::adam::{AdamFactors, adam};
use super::border::Border;
use super::convolution;
use super::dense::vector_matrix;
use super::fused::{Activation, FusedConvolution};
use super::instructions::Instructions;
use super::layouts::Part;
use super::pool::max_pool;
use super::shape::ConvolutionShape;
use super::warp::{Validity, WarpInput, warp};

/// Layers of a network, differentiable.
#[backend_extension(Flex, Autodiff)]
pub(super) trait Layers: Backend {
    /// Convolution with bias; `input` `[batch, inputs, height, width]`.
    fn convolution(
        input: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        shape: ConvolutionShape,
    ) -> FloatTensor<Self>;

    /// ReLU, then dropout.
    fn relu_dropout(input: FloatTensor<Self>, rate: DropoutRate, seed: u64) -> FloatTensor<Self>;
}

/// Operations that need no gradient.
#[backend_extension(Flex)]
pub(super) trait Operations: Backend {
    /// One step of Adam.
    fn adam(
        weight: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        moment_1: FloatTensor<Self>,
        moment_2: FloatTensor<Self>,
        factors: AdamFactors,
    ) -> AdamStep<Self>;

    /// `[1, rows]` times `[rows, columns]`.
    fn vector_matrix(input: FloatTensor<Self>, weight: FloatTensor<Self>) -> FloatTensor<Self>;

    /// A convolution and what surrounds it; `skip` and `shortcut` are looked at where the plan says so.
    fn fused_convolution(
        input: FloatTensor<Self>,
        skip: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        shortcut: FloatTensor<Self>,
        plan: FusedPlan,
    ) -> FloatTensor<Self>;

    /// Maximum over 3x3 neighbourhoods, at every second pixel.
    fn max_pool(input: FloatTensor<Self>) -> FloatTensor<Self>;

    /// The warped image and its mask.
    fn warp(
        source_image: FloatTensor<Self>,
        target_depth: FloatTensor<Self>,
        intrinsics: FloatTensor<Self>,
        source_from_target: FloatTensor<Self>,
        validity: Validity,
    ) -> WarpedImage<Self>;
}

/// How a [`FusedConvolution`] is put together.
#[derive(Clone, Copy, Debug)]
pub(super) struct FusedPlan {
    pub shape: ConvolutionShape,
    /// Whether the input is doubled in size first.
    pub doubled: bool,
    /// Channels of `skip`, behind those of the input.
    pub skip_channels: usize,
    pub border: Border,
    pub shortcut: bool,
    pub activation: Activation,
}

/// Weight and moments after a step of Adam.
#[derive(ExtensionType)]
pub(super) struct AdamStep<B: Backend> {
    pub weight: FloatTensor<B>,
    pub moment_1: FloatTensor<B>,
    pub moment_2: FloatTensor<B>,
}

/// Image `[batch, channels, height, width]` and mask `[batch, 1, height, width]`.
#[derive(ExtensionType)]
pub(super) struct WarpedImage<B: Backend> {
    pub image: FloatTensor<B>,
    pub valid_mask: FloatTensor<B>,
}

fn tensor<const D: usize>(values: Vec<f32>, shape: [usize; D]) -> FlexTensor {
    FlexTensor::new(Bytes::from_elems(values), Layout::contiguous(Shape::from(shape)), DType::F32)
}

/// The same tensor with its values in order.
fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.as_slice::<f32>().is_some() { tensor } else { tensor.to_contiguous() }
}

fn values(tensor: &FlexTensor) -> &[f32] {
    tensor.as_slice().expect("contiguous 32-bit floats")
}

/// The values to write to: in place when nobody else holds them, of a copy otherwise.
fn owned(tensor: FlexTensor) -> FlexTensor {
    let whole = tensor.is_contiguous() && tensor.storage::<f32>().len() == tensor.shape().num_elements();
    if whole { tensor } else { tensor.to_contiguous() }
}

impl Layers for Flex {
    fn convolution(input: FlexTensor, weight: FlexTensor, bias: FlexTensor, shape: ConvolutionShape) -> FlexTensor {
        let (input, weight, bias) = (contiguous(input), contiguous(weight), contiguous(bias));
        let [input, weight, bias] = [&input, &weight, &bias].map(values);
        let output = convolution::convolution(Instructions::current(), shape, input, weight, Some(bias));
        let [rows, columns] = shape.output_size();
        tensor(output, [shape.batch, shape.outputs, rows, columns])
    }

    fn relu_dropout(input: FlexTensor, rate: DropoutRate, seed: u64) -> FlexTensor {
        let mut output = owned(input);
        activation::relu_dropout(Instructions::current(), output.storage_mut(), rate, seed);
        output
    }
}

impl Operations for Flex {
    fn adam(
        weight: FlexTensor,
        gradient: FlexTensor,
        moment_1: FlexTensor,
        moment_2: FlexTensor,
        factors: AdamFactors,
    ) -> AdamStep<Self> {
        let gradient = contiguous(gradient);
        let [mut weight, mut moment_1, mut moment_2] = [weight, moment_1, moment_2].map(owned);
        adam(
            Instructions::current(),
            factors,
            weight.storage_mut(),
            values(&gradient),
            moment_1.storage_mut(),
            moment_2.storage_mut(),
        );
        AdamStep { weight, moment_1, moment_2 }
    }

    fn vector_matrix(input: FlexTensor, weight: FlexTensor) -> FlexTensor {
        let (input, weight) = (contiguous(input), contiguous(weight));
        let columns = weight.shape()[1];
        let output = vector_matrix(Instructions::current(), values(&input), values(&weight), columns);
        tensor(output, [1, columns])
    }

    fn fused_convolution(
        input: FlexTensor,
        skip: FlexTensor,
        weight: FlexTensor,
        bias: FlexTensor,
        shortcut: FlexTensor,
        plan: FusedPlan,
    ) -> FlexTensor {
        let tensors = [input, skip, weight, bias, shortcut].map(contiguous);
        let [input, skip, weight, bias, shortcut] = [0, 1, 2, 3, 4].map(|index| values(&tensors[index]));
        let FusedPlan { shape, doubled, skip_channels, border, activation, .. } = plan;
        let parts = [
            Part { values: input, channels: shape.inputs - skip_channels, doubled },
            Part { values: skip, channels: skip_channels, doubled: false },
        ];
        let parts = if skip_channels > 0 { &parts[..] } else { &parts[..1] };
        let (bias, shortcut) = (Some(bias), plan.shortcut.then_some(shortcut));
        let convolution = FusedConvolution { shape, parts, border, weight, bias, shortcut, activation };
        let [rows, columns] = shape.output_size();
        tensor(convolution.run(Instructions::current()), [shape.batch, shape.outputs, rows, columns])
    }

    fn max_pool(input: FlexTensor) -> FlexTensor {
        let input = contiguous(input);
        let shape: [usize; 4] = std::array::from_fn(|axis| input.shape()[axis]);
        let [batch, channels, height, width] = shape;
        let output = max_pool(Instructions::current(), values(&input), shape);
        tensor(output, [batch, channels, height.div_ceil(2), width.div_ceil(2)])
    }

    fn warp(
        source_image: FlexTensor,
        target_depth: FlexTensor,
        intrinsics: FlexTensor,
        source_from_target: FlexTensor,
        validity: Validity,
    ) -> WarpedImage<Self> {
        let tensors = [source_image, target_depth, intrinsics, source_from_target].map(contiguous);
        let [source_image, target_depth, intrinsics, source_from_target] = &tensors;
        let shape = source_image.shape().dims::<4>();
        let [batch, _, height, width] = shape;
        let (image, mask) = warp(
            Instructions::current(),
            WarpInput {
                source_image: values(source_image),
                target_depth: values(target_depth),
                intrinsics: values(intrinsics),
                source_from_target: values(source_from_target),
                shape,
                validity,
            },
        );
        WarpedImage { image: tensor(image, shape), valid_mask: tensor(mask, [batch, 1, height, width]) }
    }
}

#[derive(Debug)]
struct ConvolutionBackward;

impl Backward<Flex, 3> for ConvolutionBackward {
    type State = (NodeId, NodeId, ConvolutionShape);

    fn backward(self, ops: Ops<Self::State, 3>, gradients: &mut Gradients, checkpointer: &mut Checkpointer) {
        let [input_node, weight_node, bias_node] = ops.parents;
        let (input, weight, shape) = ops.state;
        let gradient = contiguous(gradients.consume::<Flex>(&ops.node));
        let [input, weight] = [input, weight].map(|node| contiguous(checkpointer.retrieve_node_output(node)));
        let instructions = Instructions::current();
        if let Some(node) = bias_node {
            let bias = convolution::bias_gradient(shape, values(&gradient));
            gradients.register::<Flex>(node.id, tensor(bias, [shape.outputs]));
        }
        if let Some(node) = weight_node {
            let weight = convolution::weight_gradient(instructions, shape, values(&input), values(&gradient));
            let [rows, columns] = shape.kernel;
            gradients.register::<Flex>(node.id, tensor(weight, [shape.outputs, shape.inputs, rows, columns]));
        }
        if let Some(node) = input_node {
            let input = convolution::input_gradient(instructions, shape, values(&weight), values(&gradient));
            let [height, width] = shape.size;
            gradients.register::<Flex>(node.id, tensor(input, [shape.batch, shape.inputs, height, width]));
        }
    }
}

#[derive(Debug)]
struct ReluDropoutBackward;

impl Backward<Flex, 1> for ReluDropoutBackward {
    type State = (FlexTensor, DropoutRate);

    fn backward(self, ops: Ops<Self::State, 1>, gradients: &mut Gradients, _: &mut Checkpointer) {
        let [node] = ops.parents;
        let (output, rate) = ops.state;
        let mut gradient = owned(gradients.consume::<Flex>(&ops.node));
        if let Some(node) = node {
            let output = contiguous(output);
            let instructions = Instructions::current();
            activation::relu_dropout_gradient(instructions, values(&output), gradient.storage_mut(), rate);
            gradients.register::<Flex>(node.id, gradient);
        }
    }
}

impl<C: CheckpointStrategy> Layers for Autodiff<Flex, C> {
    fn convolution(
        input: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        shape: ConvolutionShape,
    ) -> FloatTensor<Self> {
        let nodes = [input.node(), weight.node(), bias.node()];
        match ConvolutionBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(mut step) => {
                let state = (step.checkpoint(&input), step.checkpoint(&weight), shape);
                let output =
                    Flex::convolution(input.into_primitive(), weight.into_primitive(), bias.into_primitive(), shape);
                step.finish(state, output)
            }
            OpsKind::UnTracked(step) => step.finish(Flex::convolution(
                input.into_primitive(),
                weight.into_primitive(),
                bias.into_primitive(),
                shape,
            )),
        }
    }

    fn relu_dropout(input: FloatTensor<Self>, rate: DropoutRate, seed: u64) -> FloatTensor<Self> {
        match ReluDropoutBackward.prepare::<C>([input.node()]).compute_bound().stateful() {
            OpsKind::Tracked(step) => {
                let output = Flex::relu_dropout(input.into_primitive(), rate, seed);
                step.finish((output.clone(), rate), output)
            }
            OpsKind::UnTracked(step) => step.finish(Flex::relu_dropout(input.into_primitive(), rate, seed)),
        }
    }
}
