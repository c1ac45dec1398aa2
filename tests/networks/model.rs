//! Both networks in double precision, composed of the references of their kernels.

use nightsplat::networks::{DenoiserSettings, NetworkVariant};
use nightsplat::reference::conv3x3::{activate, conv3x3, data_gradient};
use nightsplat::reference::conv3x3_weight_gradient::weight_gradient;
use nightsplat::reference::norm::{self, NormAffine, NormStatistics};
use nightsplat::reference::residual::residual;
use nightsplat::reference::residual_backward::clamp_backward;

/// A convolution in the flat array of a network's parameters.
#[derive(Clone, Copy)]
struct Conv {
    channels: [usize; 2],
    offset: usize,
}

impl Conv {
    fn len(self) -> usize {
        self.channels[1] * (9 * self.channels[0] + 1)
    }

    fn layer(self, values: &[f64]) -> (&[f64], &[f64]) {
        let [inputs, outputs] = self.channels;
        values[self.offset..][..self.len()].split_at(9 * inputs * outputs)
    }

    fn forward(self, size: [usize; 2], values: &[f64], input: &[f64]) -> Vec<f64> {
        let (weights, biases) = self.layer(values);
        conv3x3(size, self.channels, weights, biases, input)
    }

    /// Adds to the gradients of the layer; returns the gradient of the input.
    fn backward(
        self,
        size: [usize; 2],
        values: &[f64],
        input: &[f64],
        d_output: &[f64],
        gradients: &mut [f64],
    ) -> Vec<f64> {
        let d_layer = weight_gradient(size, self.channels, input, d_output, |_| true);
        add(&mut gradients[self.offset..], &d_layer);
        data_gradient(size, self.channels, self.layer(values).0, d_output)
    }
}

fn add(to: &mut [f64], from: &[f64]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
}

fn relu(values: Vec<f64>) -> Vec<f64> {
    values.into_iter().map(|x| activate(1, x)).collect()
}

fn relu_backward(d: &mut [f64], activations: &[f64]) {
    d.iter_mut().zip(activations).filter(|(_, a)| **a <= 0.0).for_each(|(d, _)| *d = 0.0);
}

/// The results of a backward pass: dL/d parameters and dL/d both inputs.
pub(crate) struct Gradients {
    pub(crate) parameters: Vec<f64>,
    pub(crate) inputs: [Vec<f64>; 2],
}

/// The denoiser for views of one size.
#[derive(Clone, Copy)]
pub(crate) struct Denoiser {
    pub(crate) settings: DenoiserSettings,
    pub(crate) size: [usize; 2],
}

/// The state of a stage for its backward pass.
struct Stage {
    input: Vec<f64>,
    features: Vec<Vec<f64>>,
    convolved: Vec<Vec<f64>>,
    update: Vec<f64>,
    denoised: Vec<f64>,
}

impl Denoiser {
    fn convs(self, k: usize) -> ([Conv; 3], usize) {
        let channels = self.settings.channels as usize;
        let of = |channels, offset| Conv { channels, offset };
        let (first, inner) = (of([3, channels], 0), of([channels, channels], 0));
        let last = of([channels, 3], 0);
        let norm_len = 2 * channels;
        let start = k * (first.len() + inner.len() + norm_len + last.len());
        let norm = start + first.len() + inner.len();
        let convs = [
            of(first.channels, start),
            of(inner.channels, start + first.len()),
            of(last.channels, norm + norm_len),
        ];
        (convs, norm)
    }

    fn affine(self, values: &[f64], norm: usize, channel: usize) -> NormAffine {
        let channels = self.settings.channels as usize;
        NormAffine { gamma: values[norm + channel], beta: values[norm + channels + channel] }
    }

    fn stages(self, values: &[f64], noise: &[f64], render: &[f64]) -> Vec<Stage> {
        let pixels = self.size[0] * self.size[1];
        let mut stages: Vec<Stage> = vec![];
        for k in 0..self.settings.stages as usize {
            let ([conv_in, conv, conv_out], norm) = self.convs(k);
            let input = stages.last().map_or(noise, |stage| &stage.denoised).to_vec();
            let mut features = vec![relu(conv_in.forward(self.size, values, &input))];
            let mut convolved = vec![];
            for repeat in 0..self.settings.repeats as usize {
                let z = conv.forward(self.size, values, &features[repeat]);
                let mut f = features[repeat].clone();
                for (channel, z) in z.chunks(pixels).enumerate() {
                    let affine = self.affine(values, norm, channel);
                    add(
                        &mut f[channel * pixels..],
                        &norm::forward(NormStatistics::from_values(z), affine, z),
                    );
                }
                features.push(f);
                convolved.push(z);
            }
            let v = conv_out.forward(self.size, values, features.last().unwrap());
            let (update, denoised): (Vec<f64>, Vec<f64>) = match self.settings.variant {
                NetworkVariant::Identity => {
                    let denoised = input.iter().zip(&v).map(|(input, v)| input - v).collect();
                    (v, denoised)
                }
                NetworkVariant::Paper => {
                    let update: Vec<f64> = v.into_iter().map(|v| activate(2, v)).collect();
                    let end = |i: usize| residual(render[i], input[i], update[i]);
                    let denoised = (0..3 * pixels).map(end).collect();
                    (update, denoised)
                }
            };
            stages.push(Stage { input, features, convolved, update, denoised });
        }
        stages
    }

    pub(crate) fn forward(self, values: &[f64], noise: &[f64], render: &[f64]) -> Vec<f64> {
        self.stages(values, noise, render).pop().unwrap().denoised
    }

    /// The gradients of the parameters, the noise map and the render.
    pub(crate) fn backward(
        self,
        values: &[f64],
        noise: &[f64],
        render: &[f64],
        d_denoised: &[f64],
    ) -> Gradients {
        let pixels = self.size[0] * self.size[1];
        let mut gradients = vec![0.0; values.len()];
        let (mut d, mut d_render) = (d_denoised.to_vec(), vec![0.0; render.len()]);
        for (k, stage) in self.stages(values, noise, render).iter().enumerate().rev() {
            let ([conv_in, conv, conv_out], norm) = self.convs(k);
            let is_paper = self.settings.variant == NetworkVariant::Paper;
            if is_paper {
                for i in 0..d.len() {
                    d[i] = clamp_backward(render[i] - (stage.input[i] + stage.update[i]), d[i]);
                }
                add(&mut d_render, &d);
            }
            let slope = |u: f64| if is_paper { u * (1.0 - u) } else { 1.0 };
            let d_v: Vec<f64> = d.iter().zip(&stage.update).map(|(d, &u)| -d * slope(u)).collect();
            let last = stage.features.last().unwrap();
            let mut d_f = conv_out.backward(self.size, values, last, &d_v, &mut gradients);
            for repeat in (0..self.settings.repeats as usize).rev() {
                let mut d_z = vec![];
                let per_channel = stage.convolved[repeat].chunks(pixels).zip(d_f.chunks(pixels));
                for (channel, (z, d)) in per_channel.enumerate() {
                    let affine = self.affine(values, norm, channel);
                    let statistics = NormStatistics::from_values(z);
                    let sums = norm::backward_sums(statistics, affine, z, d);
                    let channels = self.settings.channels as usize;
                    gradients[norm + channel] += sums[1];
                    gradients[norm + channels + channel] += sums[0];
                    let means = sums.map(|sum| sum / pixels as f64);
                    d_z.extend(norm::backward(statistics, affine, means, z, d));
                }
                let input = &stage.features[repeat];
                add(&mut d_f, &conv.backward(self.size, values, input, &d_z, &mut gradients));
            }
            relu_backward(&mut d_f, &stage.features[0]);
            let d_input = conv_in.backward(self.size, values, &stage.input, &d_f, &mut gradients);
            if is_paper {
                d.iter_mut().for_each(|d| *d = -*d);
            }
            add(&mut d, &d_input);
        }
        Gradients { parameters: gradients, inputs: [d, d_render] }
    }
}

/// The tonemapper for views of one size.
#[derive(Clone, Copy)]
pub(crate) struct Tonemapper {
    pub(crate) variant: NetworkVariant,
    pub(crate) size: [usize; 2],
}

impl Tonemapper {
    fn convs() -> [Conv; 3] {
        let mut offset = 0;
        [[3, 16], [16, 16], [16, 3]].map(|channels| {
            let conv = Conv { channels, offset };
            offset += conv.len();
            conv
        })
    }

    /// Product, first and second features, output.
    fn layers(self, values: &[f64], illumination: &[f64], denoised: &[f64]) -> [Vec<f64>; 4] {
        let [conv1, conv2, conv3] = Self::convs();
        let product: Vec<f64> = illumination.iter().zip(denoised).map(|(l, r)| l * r).collect();
        let first = relu(conv1.forward(self.size, values, &product));
        let second = relu(conv2.forward(self.size, values, &first));
        let mut output = conv3.forward(self.size, values, &second);
        if self.variant == NetworkVariant::Identity {
            add(&mut output, &product);
        }
        [product, first, second, output]
    }

    pub(crate) fn forward(
        self,
        values: &[f64],
        illumination: &[f64],
        denoised: &[f64],
    ) -> Vec<f64> {
        let [.., output] = self.layers(values, illumination, denoised);
        output
    }

    /// The gradients of the parameters, the illumination and the denoised image.
    pub(crate) fn backward(
        self,
        values: &[f64],
        illumination: &[f64],
        denoised: &[f64],
        d_output: &[f64],
    ) -> Gradients {
        let [conv1, conv2, conv3] = Self::convs();
        let [product, first, second, _] = self.layers(values, illumination, denoised);
        let mut parameters = vec![0.0; values.len()];
        let mut d_second = conv3.backward(self.size, values, &second, d_output, &mut parameters);
        relu_backward(&mut d_second, &second);
        let mut d_first = conv2.backward(self.size, values, &first, &d_second, &mut parameters);
        relu_backward(&mut d_first, &first);
        let mut d_product = conv1.backward(self.size, values, &product, &d_first, &mut parameters);
        if self.variant == NetworkVariant::Identity {
            add(&mut d_product, d_output);
        }
        let times = |by: &[f64]| d_product.iter().zip(by).map(|(d, by)| d * by).collect();
        Gradients { inputs: [times(denoised), times(illumination)], parameters }
    }
}
