//! A minimal file of a camera.

/// Sensor values without light, and at saturation.
pub(crate) const BLACK: u16 = 256;
pub(crate) const WHITE: u16 = 65_280;
/// Sensor values of white, relative to green.
pub(crate) const NEUTRAL: [f32; 3] = [0.5, 1.0, 2.0 / 3.0];

/// Sensor value of light.
pub(crate) fn counted(light: [f32; 3]) -> [u16; 3] {
    let range = f32::from(WHITE - BLACK);
    std::array::from_fn(|k| BLACK + (range * NEUTRAL[k] * light[k]).round() as u16)
}

/// A minimal linear DNG: 16-bit pixels of three colours in one strip, the camera's neutral, black and white levels.
pub(crate) fn dng(width: u16, height: u16, pixel: impl FnMut(u16, u16) -> [u16; 3]) -> Vec<u8> {
    dng_of(width, height, false, pixel)
}

/// [`dng`], or one of a mosaic: red, green; green, blue.
pub(crate) fn dng_of(
    width: u16,
    height: u16,
    is_mosaic: bool,
    mut pixel: impl FnMut(u16, u16) -> [u16; 3],
) -> Vec<u8> {
    let short = |values: &[u16]| {
        (
            3_u16,
            values.len() as u32,
            values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>(),
        )
    };
    let rational = |type_: u16, values: &[[i32; 2]]| {
        (
            type_,
            values.len() as u32,
            values.iter().flatten().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>(),
        )
    };
    let text = |text: &str| (2_u16, text.len() as u32 + 1, [text.as_bytes(), &[0]].concat());
    let bytes = |values: &[u8]| (1_u16, values.len() as u32, values.to_vec());
    let long = |value: u32| (4_u16, 1_u32, value.to_le_bytes().to_vec());
    let pixels: Vec<u8> = (0..height)
        .flat_map(|y| (0..width).map(move |x| (x, y)))
        .flat_map(|(x, y)| match is_mosaic {
            true => vec![pixel(x, y)[usize::from(x % 2 + y % 2)]],
            false => pixel(x, y).to_vec(),
        })
        .flat_map(u16::to_le_bytes)
        .collect();
    // From XYZ to the camera's colours, which are sRGB's.
    let matrix = [32405, -15371, -4985, -9693, 18760, 416, 556, -2040, 10572].map(|v| [v, 10_000]);
    let samples = if is_mosaic { 1 } else { 3 };
    let mut entries = vec![
        (254, long(0)),
        (256, long(width.into())),
        (257, long(height.into())),
        (258, short(&[16; 3][..samples])),
        (259, short(&[1])),
        (262, short(&[if is_mosaic { 32803 } else { 34892 }])),
        (271, text("Test")),
        (272, text("Linear")),
        (273, long(8)),
        (274, short(&[1])),
        (277, short(&[samples as u16])),
        (278, long(height.into())),
        (279, long(pixels.len() as u32)),
        (284, short(&[1])),
        (50706, bytes(&[1, 4, 0, 0])),
        (50707, bytes(&[1, 1, 0, 0])),
        (50708, text("Test Linear")),
        (50714, short(&[BLACK; 3][..samples])),
        (50717, short(&[WHITE; 3][..samples])),
        (50721, rational(10, &matrix)),
        (50728, rational(5, &[[1, 2], [1, 1], [2, 3]])),
        (50778, short(&[21])),
    ];
    if is_mosaic {
        entries.extend([(33421, short(&[2, 2])), (33422, bytes(&[0, 1, 1, 2]))]);
    }
    entries.sort_by_key(|(tag, _)| *tag);
    let directory = 8 + pixels.len();
    let mut after = directory + 2 + 12 * entries.len() + 4;
    let mut file = [b"II*\0".as_slice(), &(directory as u32).to_le_bytes(), &pixels].concat();
    file.extend((entries.len() as u16).to_le_bytes());
    let mut values = vec![];
    for (tag, (type_, count, mut value)) in entries {
        file.extend((tag as u16).to_le_bytes());
        file.extend(type_.to_le_bytes());
        file.extend(count.to_le_bytes());
        if value.len() <= 4 {
            value.resize(4, 0);
            file.extend(value);
        } else {
            file.extend((after as u32).to_le_bytes());
            value.resize(value.len().next_multiple_of(2), 0);
            after += value.len();
            values.extend(value);
        }
    }
    file.extend([0; 4]);
    file.extend(values);
    file
}
