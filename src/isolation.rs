//! A job's process gives up the network before it reads a byte of the scan: a fault in a decoder then reaches nobody.
//!
//! Two barriers, each by itself enough for TCP and UDP: a network namespace of its own, in which not even the loopback
//! device is up, and a filter of system calls that refuses `socket`, so that no file-system socket (a database's, say) can
//! be reached either. The namespace needs the right to make one (root, or user namespaces); containers often forbid it,
//! and then the filter stands alone. What came about is the first line that the worker hears.

use nix::libc;
use nix::sched::{CloneFlags, unshare};
use seccompiler::{BpfProgram, SeccompAction, SeccompFilter, TargetArch};

/// System calls that a reconstruction never makes: sockets, looking into other processes, new namespaces and mounts.
const REFUSED: &[i64] = &[
    libc::SYS_socket,
    libc::SYS_socketpair,
    libc::SYS_ptrace,
    libc::SYS_process_vm_readv,
    libc::SYS_process_vm_writev,
    libc::SYS_unshare,
    libc::SYS_setns,
    libc::SYS_mount,
    libc::SYS_bpf,
    libc::SYS_io_uring_setup,
];

/// Gives up the network for good and names the barriers that stand: `namespace, filter`, one of them, or `none`. To be
/// called while the process has one thread: others would keep what they have.
pub(crate) fn leave_network() -> &'static str {
    // Root may leave its network as it is; anybody else may in a user namespace of his own.
    let alone = unshare(CloneFlags::CLONE_NEWNET)
        .or_else(|_| unshare(CloneFlags::CLONE_NEWUSER | CloneFlags::CLONE_NEWNET))
        .is_ok();
    match (alone, filtered().is_ok()) {
        (true, true) => "namespace, filter",
        (true, false) => "namespace",
        (false, true) => "filter",
        (false, false) => "none",
    }
}

fn filtered() -> Result<(), seccompiler::Error> {
    let rules = REFUSED.iter().map(|&call| (call, Vec::new())).collect();
    let refuse = SeccompAction::Errno(libc::EPERM.unsigned_abs());
    let machine = TargetArch::try_from(std::env::consts::ARCH)?;
    let program: BpfProgram = SeccompFilter::new(rules, SeccompAction::Allow, refuse, machine)?.try_into()?;
    seccompiler::apply_filter(&program)
}
