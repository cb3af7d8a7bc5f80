//! CAN interfaces of Linux: a raw socket, classic and CAN-FD frames.

#![allow(unsafe_code)]

use std::io;
use std::mem::{size_of, zeroed};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::time::{Duration, Instant};

use composer_shared::wire::Frame;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;

use super::{BusError, Transport};

/// Flag of a CAN-FD frame: with bit-rate switch.
const BRS: u8 = libc::CANFD_BRS as u8;

/// An open interface.
#[derive(Debug)]
pub struct SocketCan {
    socket: OwnedFd,
    name: String,
    fd: bool,
    opened: Instant,
}

impl SocketCan {
    /// Opens the interface `name`. It is CAN-FD if the interface is configured so.
    pub fn open(name: &str) -> Result<Self, BusError> {
        let refuse = |reason: String| BusError::Open { transport: name.into(), reason };
        let system = |what: &str| {
            let error = io::Error::last_os_error();
            refuse(match error.raw_os_error() {
                Some(libc::EAFNOSUPPORT) => "this kernel has no SocketCAN: load the modules can and can_raw, or use a serial adapter, slcan:/dev/tty...".into(),
                _ => format!("{what}: {error}"),
            })
        };
        // SAFETY: a plain system call; its result is checked before it is used.
        let socket = unsafe { libc::socket(libc::PF_CAN, libc::SOCK_RAW | libc::SOCK_CLOEXEC, libc::CAN_RAW) };
        if socket < 0 {
            return Err(system("no socket"));
        }
        // SAFETY: `socket` is a descriptor that nobody else has.
        let socket = unsafe { OwnedFd::from_raw_fd(socket) };
        // SAFETY: `ifreq` is plain data, for which zeros are valid.
        let mut request: libc::ifreq = unsafe { zeroed() };
        let room = request.ifr_name.len() - 1;
        for (to, from) in request.ifr_name[..room].iter_mut().zip(name.bytes()) {
            *to = from as libc::c_char;
        }
        // SAFETY: `request` lives and has the layout that these requests take; the name ends with a zero.
        if unsafe { libc::ioctl(socket.as_raw_fd(), libc::SIOCGIFINDEX as _, &mut request) } < 0 {
            return Err(refuse(format!(
                "there is no interface {name}; `ip link` lists them, `ip link set {name} up type can bitrate 1000000 dbitrate 5000000 fd on` starts one"
            )));
        }
        // SAFETY: the request has filled this member of the union.
        let index = unsafe { request.ifr_ifru.ifru_ifindex };
        // SAFETY: as above.
        if unsafe { libc::ioctl(socket.as_raw_fd(), libc::SIOCGIFMTU as _, &mut request) } < 0 {
            return Err(system("its frame size is not known"));
        }
        // SAFETY: as above.
        let fd = unsafe { request.ifr_ifru.ifru_mtu } as usize >= size_of::<libc::canfd_frame>();
        let on: libc::c_int = 1;
        // SAFETY: `on` lives, and its size is given.
        let done = unsafe {
            let value = (&raw const on).cast();
            libc::setsockopt(
                socket.as_raw_fd(),
                libc::SOL_CAN_RAW,
                libc::CAN_RAW_FD_FRAMES,
                value,
                size_of::<libc::c_int>() as _,
            )
        };
        if fd && done < 0 {
            return Err(system("it does not carry CAN-FD frames"));
        }
        // SAFETY: plain data, for which zeros are valid.
        let mut address: libc::sockaddr_can = unsafe { zeroed() };
        address.can_family = libc::AF_CAN as _;
        address.can_ifindex = index;
        // SAFETY: `address` lives, and its size is given.
        let bound = unsafe {
            libc::bind(socket.as_raw_fd(), (&raw const address).cast(), size_of::<libc::sockaddr_can>() as _)
        };
        if bound < 0 {
            return Err(system("it cannot be bound"));
        }
        Ok(SocketCan { socket, name: name.into(), fd, opened: Instant::now() })
    }

    fn failed(&self, error: Errno) -> BusError {
        let reason = match error {
            Errno::NETDOWN | Errno::NODEV | Errno::NXIO => {
                format!("the interface is down; `ip link set {} up` starts it", self.name)
            }
            Errno::NOBUFS => "its queue is full: nobody on the bus acknowledges".into(),
            error => io::Error::from(error).to_string(),
        };
        BusError::Failed { transport: self.name.clone(), reason }
    }
}

/// The bytes of a frame as the kernel takes them: `can_frame` (16) or `canfd_frame` (72), whose first fields agree.
fn to_kernel(frame: &Frame) -> ([u8; 72], usize) {
    let mut bytes = [0; 72];
    bytes[..4].copy_from_slice(&u32::from(frame.id).to_ne_bytes());
    bytes[4] = frame.len;
    if frame.brs {
        bytes[5] = BRS;
    }
    bytes[8..].copy_from_slice(&frame.data);
    (bytes, if frame.fd { 72 } else { 16 })
}

/// The frame that the kernel gave; none for remote, error and 29-bit frames.
fn from_kernel(bytes: &[u8]) -> Option<Frame> {
    let fd = match bytes.len() {
        16 => false,
        72 => true,
        _ => return None,
    };
    let id = u32::from_ne_bytes(bytes[..4].try_into().ok()?);
    let data = bytes.get(8..8 + usize::from(bytes[4]))?;
    let frame = Frame::new(u16::try_from(id).ok()?, fd, data).filter(|frame| frame.len == bytes[4])?;
    Some(Frame { brs: fd && bytes[5] & BRS != 0, ..frame })
}

impl Transport for SocketCan {
    fn send(&mut self, frame: &Frame) -> Result<(), BusError> {
        let (bytes, length) = to_kernel(frame);
        loop {
            match rustix::io::write(&self.socket, &bytes[..length]) {
                Ok(_) => return Ok(()),
                Err(Errno::INTR) => {}
                Err(error) => return Err(self.failed(error)),
            }
        }
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<Frame>, BusError> {
        let start = Instant::now();
        loop {
            let left = patience.saturating_sub(start.elapsed());
            let time = Timespec { tv_sec: left.as_secs() as _, tv_nsec: left.subsec_nanos() as _ };
            let mut fds = [PollFd::new(&self.socket, PollFlags::IN)];
            match poll(&mut fds, Some(&time)) {
                Ok(0) => return Ok(None),
                Ok(_) => {}
                Err(Errno::INTR) => return Ok(None),
                Err(error) => return Err(self.failed(error)),
            }
            let mut bytes = [0; 72];
            match rustix::io::read(&self.socket, &mut bytes) {
                Ok(length) => {
                    if let Some(frame) = from_kernel(&bytes[..length]) {
                        return Ok(Some(frame));
                    }
                }
                Err(Errno::INTR | Errno::AGAIN) => {}
                Err(error) => return Err(self.failed(error)),
            }
        }
    }

    fn fd(&self) -> bool {
        self.fd
    }

    fn now(&self) -> Duration {
        self.opened.elapsed()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernels_frames_are_ours() {
        assert_eq!((size_of::<libc::can_frame>(), size_of::<libc::canfd_frame>()), (16, 72));
        for frame in [
            Frame::new(0x7f, false, &[1, 0]).unwrap(),
            Frame::new(0x203, true, &[7; 52]).unwrap(),
            Frame { brs: false, ..Frame::new(0x7ff, true, &[]).unwrap() },
        ] {
            let (bytes, length) = to_kernel(&frame);
            assert_eq!(from_kernel(&bytes[..length]), Some(frame));
        }
        let (mut bytes, _) = to_kernel(&Frame::new(0x7f, false, &[1]).unwrap());
        bytes[..4].copy_from_slice(&(0x7f | libc::CAN_EFF_FLAG).to_ne_bytes());
        assert_eq!(from_kernel(&bytes[..16]), None, "29 bits");
        bytes[..4].copy_from_slice(&(0x7f | libc::CAN_ERR_FLAG).to_ne_bytes());
        assert_eq!(from_kernel(&bytes[..16]), None, "an error frame");
        assert_eq!(from_kernel(&bytes[..9]), None);
    }

    #[test]
    fn an_interface_that_is_not_there_gets_a_sentence() {
        let error = SocketCan::open("nocan9").unwrap_err().to_string();
        assert!(
            error.contains("nocan9 cannot be opened") && (error.contains("ip link") || error.contains("no SocketCAN")),
            "{error}"
        );
    }
}
