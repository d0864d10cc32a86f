//! Borrows iceoryx2's file descriptors.

use crate::Service;
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::FileDescriptorBased;
use std::os::fd::BorrowedFd;

/// Returns the descriptor that becomes readable when the listener is notified.
pub(crate) fn of_listener(listener: &Listener<Service>) -> BorrowedFd<'_> {
    // SAFETY: the raw number is only used to borrow it on the next line; nothing closes or owns it here.
    let raw = unsafe { listener.file_descriptor().native_handle() };
    // SAFETY: the listener owns the descriptor and keeps it open for as long as it lives, and the result's lifetime
    // ends with the borrow of the listener.
    unsafe { BorrowedFd::borrow_raw(raw) }
}
