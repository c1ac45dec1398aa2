//! Opens a device and tests what its Vulkan limits and features do not guarantee: subgroups of the size that the
//! kernels are compiled for, their operations, memory between workgroups, and functions. A device that fails would
//! train to wrong results without a message.

use crate::gpu::{DeviceChoice, Gpu, Properties, SUBGROUP_VARIABLE, Threads};
use crate::kernels::self_test::{
    self, CHECK_BALLOT, CHECK_EXP, CHECK_HALF, CHECK_LANE, CHECK_LAST, CHECK_LOG, CHECK_SHUFFLE,
    CHECK_SIZE, CHECK_SQRT, CHECK_SUBGROUP, CHECK_SUM, CHECK_WORD, CHECKS, Constants,
    FUNCTION_VALUES, Kernel, Params, SUBGROUPS, WORKGROUPS,
};
use crate::{Error, Result};

/// The variable that is `off` where devices are opened untested, and `always` where the command compiles every kernel
/// in a process of its own before it opens a software device too.
pub(crate) const TEST_VARIABLE: &str = "NIGHTSPLAT_DEVICE_TEST";

/// Numbers of each function.
const COUNT: usize = FUNCTION_VALUES as usize;

/// What the kernel reads: arguments of functions, a third, and two words, of which the first is a subnormal float.
const NUMBERS: [f32; COUNT + 3] = [
    1e-6,
    0.1,
    0.75,
    1.0,
    1.5,
    2.5,
    7.25,
    80.0,
    1.0 / 3.0,
    f32::from_bits(0x0000_1234),
    f32::from_bits(0x4567_89ab),
];

/// exp, log and sqrt of the numbers, each with the error that Vulkan allows ("Precision of core SPIR-V instructions"),
/// four times.
pub(crate) fn functions(numbers: &[f32]) -> Vec<(f64, f64)> {
    const ULP: f64 = f32::EPSILON as f64;
    let of = |function: fn(f64) -> (f64, f64)| {
        numbers
            .iter()
            .take(COUNT)
            .map(move |&x| function(x.into()))
            .map(|(value, ulps)| (value, 4.0 * ULP * ulps))
    };
    let exp = of(|x| (x.exp(), (3.0 + 2.0 * x) * x.exp()));
    let log = of(|x| (x.ln(), 4.0 + 3.0 * x.ln().abs()));
    let sqrt = of(|x| (x.sqrt(), 4.5 * x.sqrt()));
    exp.chain(log).chain(sqrt).collect()
}

/// What the kernel left.
struct SelfTestResult {
    differing: Vec<u32>,
    arrivals: Vec<u32>,
    values: Vec<f32>,
    words: Vec<f32>,
}

impl Gpu {
    /// Opens a device, and tests it. Debug builds turn on validation where the layer is installed.
    ///
    /// # Errors
    /// No loader, no such device, one that lacks a requirement, or one that fails [`Gpu::self_test`].
    ///
    /// ```no_run
    /// use nightsplat::{DeviceChoice, Gpu};
    ///
    /// let gpu = Gpu::new(&DeviceChoice::Best)?;
    /// let squares = gpu.buffer("squares", &[0u32, 1, 4, 9])?;
    /// assert_eq!(gpu.read(&squares)?, [0, 1, 4, 9]);
    /// # Ok::<(), nightsplat::Error>(())
    /// ```
    pub fn new(choice: &DeviceChoice) -> Result<Self> {
        Self::open(choice)?.tested()
    }

    /// [`Gpu::new`] with validation and synchronization validation; its tile sizes are the built-in ones.
    ///
    /// # Errors
    /// As [`Gpu::new`], or the validation layer is not installed.
    pub fn with_validation(choice: &DeviceChoice) -> Result<Self> {
        Self::open_validated(choice)?.tested()
    }

    pub(crate) fn tested(self) -> Result<Self> {
        if std::env::var_os(TEST_VARIABLE).is_none_or(|value| value != "off") {
            self.self_test()?;
        }
        Ok(self)
    }

    /// Tests what the kernels depend on and Vulkan's limits and features do not guarantee: subgroups, memory between
    /// workgroups, and functions. A device that a host lends is not tested automatically, since the test submits; the
    /// host may call this once.
    ///
    /// # Errors
    /// [`Error::SelfTest`], which names the first check that fails; the device only records, refuses the kernel, or was
    /// lost.
    pub fn self_test(&self) -> Result<()> {
        #[cfg(debug_assertions)]
        let _paused = crate::gpu::testing::pause_faults(self);
        let found = self.run_self_test()?;
        self.free_unused();
        let Properties { name, driver, subgroup_size, .. } = self.properties();
        let failed = (0..CHECKS).find_map(|check| found.problem(check, *subgroup_size));
        failed.map_or(Ok(()), |(what, remedy)| {
            Err(Error::SelfTest { device: format!("{name}, {driver}"), what, remedy })
        })
    }

    /// Compiles every kernel with its default constants, and calls `begins` with its name before.
    pub(crate) fn compile_all(&self, mut begins: impl FnMut(&str)) -> Result<()> {
        // Those with matrices have other constants on each device.
        let matrices = |name: &str| name.ends_with("_half");
        let kernels = crate::kernels::ALL.iter().filter(|(interface, _)| !matrices(interface.name));
        for (interface, constants) in kernels {
            begins(interface.name);
            self.compile(interface, constants())?;
        }
        Ok(())
    }

    fn run_self_test(&self) -> Result<SelfTestResult> {
        #[cfg(debug_assertions)]
        let planted = crate::gpu::testing::faults(self).planted_check().unwrap_or(CHECKS);
        #[cfg(not(debug_assertions))]
        let planted = CHECKS;
        let pipeline = self.pipeline::<Kernel>(&Constants::default())?;
        let numbers = self.buffer("numbers", &NUMBERS)?;
        let mut sums = self.uninit("sums", SUBGROUPS as usize)?;
        let mut arrivals = self.uninit("arrivals", 3)?;
        let mut differing = self.uninit("differing", 2 * CHECKS as usize)?;
        let mut values = self.uninit("values", 3 * COUNT)?;
        let mut words = self.uninit("words", 2)?;
        let (differing, arrivals, values, words) = self.run("self_test", |pass| {
            pass.fill(&mut arrivals, 0);
            pass.fill(&mut differing, 0);
            for turn in 0..2 {
                let buffers = self_test::Buffers {
                    numbers: numbers.slice(),
                    sums: sums.slice_mut(),
                    arrivals: arrivals.slice_mut(),
                    differing: differing.slice_mut(),
                    values: values.slice_mut(),
                    words: words.slice_mut(),
                };
                let threads = Threads::Workgroups([WORKGROUPS, 1, 1]);
                pass.dispatch(&pipeline, &Params { turn, planted }, buffers, threads)?;
            }
            let (differing, arrivals) = (pass.download(&differing)?, pass.download(&arrivals)?);
            Ok((differing, arrivals, pass.download(&values)?, pass.download(&words)?))
        })?;
        Ok(SelfTestResult {
            differing: differing.wait()?,
            arrivals: arrivals.wait()?,
            values: values.wait()?,
            words: words.wait()?,
        })
    }
}

impl SelfTestResult {
    /// The problem that a check found and its remedy, where it found one.
    fn problem(&self, check: u32, lanes: u32) -> Option<(String, String)> {
        let [count, value] = [0, 1].map(|word| self.differing[2 * check as usize + word]);
        let differs = match check {
            CHECK_LAST => count > 0 || self.arrivals != [0, 1, 1],
            CHECK_WORD => {
                let bits = [0, 1].map(|word| self.words[word].to_bits());
                bits != [2, 1].map(|word| NUMBERS[COUNT + word].to_bits())
            }
            CHECK_EXP | CHECK_LOG | CHECK_SQRT => {
                let first = (check - CHECK_EXP) as usize * COUNT;
                let functions = functions(&NUMBERS);
                // Positive phrasing: a NaN differs.
                let agrees = |i: usize| {
                    let (value, bound) = functions[i];
                    (f64::from(self.values[i]) - value).abs() <= bound
                };
                !(first..first + COUNT).all(agrees)
            }
            _ => count > 0,
        };
        if !differs {
            return None;
        }
        let what = match check {
            CHECK_SIZE => format!("subgroups have {value} lanes where {lanes} were asked for"),
            CHECK_LANE => "lanes of a subgroup are not in the order of its threads".to_owned(),
            CHECK_SUBGROUP => "subgroups of a workgroup are not in order".to_owned(),
            CHECK_BALLOT => "subgroupBallot is wrong".to_owned(),
            CHECK_SHUFFLE => "subgroupShuffle is wrong".to_owned(),
            CHECK_SUM => "subgroupInclusiveAdd is wrong".to_owned(),
            CHECK_LAST => "the last workgroup does not see what the others wrote".to_owned(),
            CHECK_HALF => "packHalf2x16 is wrong".to_owned(),
            CHECK_WORD => "a word changes where it is moved as a float".to_owned(),
            CHECK_EXP => "exp is less precise than Vulkan requires".to_owned(),
            CHECK_LOG => "log is less precise than Vulkan requires".to_owned(),
            _ => "sqrt is less precise than Vulkan requires".to_owned(),
        };
        let of_subgroups = CHECK_SIZE..=CHECK_LAST;
        let remedy = match (check, of_subgroups.contains(&check)) {
            (CHECK_SIZE, _) => format!("set {SUBGROUP_VARIABLE}={value}"),
            (_, true) => format!("set {SUBGROUP_VARIABLE} to another size, or update the driver"),
            _ => "update the driver".to_owned(),
        };
        Some((what, remedy))
    }
}
