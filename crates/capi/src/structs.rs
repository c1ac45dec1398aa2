//! Structs that begin with their size: members are only ever appended.
//!
//! A caller's shorter struct is read as if zeros followed; a longer one is taken where its tail is zeros.

use super::error::{Failure, NSP_ERROR_VERSION};

/// A struct whose first member is `size_t struct_size`.
///
/// # Safety
/// `repr(C)`, with the size first, and valid where all bytes are zero.
pub(super) unsafe trait Sized0 {
    /// Its name.
    const NAME: &'static str;
    /// Its size in version 0.1.
    const FIRST_SIZE: usize;
}

/// More bytes than any version has.
const MOST: usize = 1 << 16;

/// Reads a caller's struct.
///
/// # Safety
/// `from` is null, or points at as many bytes as its first member says.
pub(super) unsafe fn read<T: Sized0 + Copy>(from: *const T) -> Result<T, Failure> {
    // SAFETY: as the caller promises; the size is read unaligned, as a packed copy may hold it.
    let size = unsafe { size_of_struct(from)? };
    // SAFETY: valid where all bytes are zero, as its trait says.
    let mut copy: T = unsafe { std::mem::zeroed() };
    let (taken, bytes) = (size.min(size_of::<T>()), from.cast::<u8>());
    // SAFETY: the caller's struct is `size` bytes, of which these fit ours.
    unsafe { std::ptr::copy_nonoverlapping(bytes, (&raw mut copy).cast(), taken) };
    // SAFETY: as above.
    let has_more = (taken..size).any(|at| unsafe { *bytes.add(at) } != 0);
    if has_more {
        let known = size_of::<T>();
        return Err(Failure::new(
            NSP_ERROR_VERSION,
            format!(
                "{}::struct_size is {size}, and bytes beyond the {known} that this library reads are not 0",
                T::NAME
            ),
        ));
    }
    Ok(copy)
}

/// Reads a caller's array, whose elements are as long as the first says.
///
/// # Safety
/// `from` points at `count` structs of that size.
pub(super) unsafe fn read_all<T: Sized0 + Copy>(
    from: *const T,
    count: u32,
) -> Result<Vec<T>, Failure> {
    // SAFETY: as the caller promises.
    let size = unsafe { size_of_struct(from)? };
    let element = |at: usize| from.cast::<u8>().wrapping_add(at * size).cast::<T>();
    // SAFETY: as the caller promises.
    (0..count as usize).map(|at| unsafe { read(element(at)) }).collect()
}

/// # Safety
/// As [`read`].
unsafe fn size_of_struct<T: Sized0>(from: *const T) -> Result<usize, Failure> {
    let name = T::NAME;
    if from.is_null() {
        return Err(Failure::usage(format!("{name} is NULL")));
    }
    // SAFETY: the struct begins with its size.
    let size = unsafe { from.cast::<usize>().read_unaligned() };
    if size == 0 {
        let remedy = format!("set it to sizeof({name})");
        return Err(Failure::usage(format!("{name}::struct_size is 0; {remedy}")));
    }
    if size < T::FIRST_SIZE || size > MOST {
        let text = format!("{name}::struct_size is {size}; version 0.1 has {}", T::FIRST_SIZE);
        return Err(Failure::new(NSP_ERROR_VERSION, text));
    }
    Ok(size)
}

/// Fills a caller's struct, as far as it is long; its size stays.
///
/// # Safety
/// As [`read`], and nothing else uses it.
pub(super) unsafe fn write<T: Sized0 + Copy>(to: *mut T, from: &T) -> Result<(), Failure> {
    // SAFETY: as the caller promises.
    let size = unsafe { size_of_struct(to)? };
    let skipped = size_of::<usize>();
    let taken = size.min(size_of::<T>()) - skipped;
    // SAFETY: both are this long beyond their first member.
    unsafe {
        let bytes = std::ptr::from_ref(from).cast::<u8>().add(skipped);
        std::ptr::copy_nonoverlapping(bytes, to.cast::<u8>().add(skipped), taken);
    }
    Ok(())
}

/// Fills a caller's array, whose elements are as long as the first says; each gets that size.
///
/// # Safety
/// As [`read_all`], and nothing else uses it.
#[cfg(feature = "train")]
pub(super) unsafe fn write_all<T: Sized0 + Copy>(
    to: *mut T,
    from: impl ExactSizeIterator<Item = T>,
) -> Result<(), Failure> {
    if from.len() == 0 {
        return Ok(());
    }
    // SAFETY: as the caller promises.
    let size = unsafe { size_of_struct(to) }?;
    for (at, value) in from.enumerate() {
        let element = to.cast::<u8>().wrapping_add(at * size).cast::<T>();
        // SAFETY: as the caller promises.
        unsafe {
            element.cast::<usize>().write_unaligned(size);
            write(element, &value)?;
        }
    }
    Ok(())
}

/// The object that a pointer names.
///
/// # Safety
/// Null, or valid.
pub(super) unsafe fn object<'a, T>(pointer: *const T, name: &str) -> Result<&'a T, Failure> {
    // SAFETY: as the caller promises.
    unsafe { pointer.as_ref() }.ok_or_else(|| Failure::usage(format!("{name} is NULL")))
}

/// The object that a pointer names, to change.
///
/// # Safety
/// Null, or valid and used by nothing else.
pub(super) unsafe fn object_mut<'a, T>(pointer: *mut T, name: &str) -> Result<&'a mut T, Failure> {
    // SAFETY: as the caller promises.
    unsafe { pointer.as_mut() }.ok_or_else(|| Failure::usage(format!("{name} is NULL")))
}

/// Puts a new object where the caller wants it.
///
/// # Safety
/// `out` is null or valid.
pub(super) unsafe fn give<T>(
    out: *mut *mut T,
    name: &str,
    make: impl FnOnce() -> Result<T, Failure>,
) -> Result<(), Failure> {
    // SAFETY: as the caller promises.
    let out = unsafe { object_mut(out, name)? };
    *out = std::ptr::null_mut();
    *out = Box::into_raw(Box::new(make()?));
    Ok(())
}

/// Destroys an object.
///
/// # Safety
/// Null, or of [`give`], and never used again.
pub(super) unsafe fn destroy<T>(name: &str, pointer: *mut T) {
    if !pointer.is_null() {
        super::error::guard(name, || {
            // SAFETY: as the caller promises.
            drop(unsafe { Box::from_raw(pointer) });
            Ok(())
        });
    }
}

/// A path or text of the caller's.
///
/// # Safety
/// Null, or ends with NUL.
pub(super) unsafe fn text<'a>(
    pointer: *const std::ffi::c_char,
    name: &str,
) -> Result<&'a str, Failure> {
    if pointer.is_null() {
        return Err(Failure::usage(format!("{name} is NULL")));
    }
    // SAFETY: as the caller promises.
    let text = unsafe { std::ffi::CStr::from_ptr(pointer) }.to_str();
    text.map_err(|_| Failure::usage(format!("{name} is not UTF-8")))
}
