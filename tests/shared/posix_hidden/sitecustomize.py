"""Hides from every Python process what Windows does not have: put this folder on PYTHONPATH.

Modules and attributes of the standard library are hidden; `os.name` and `sys.platform` stay, since the standard library
needs them. So does what the standard library (os.WNOHANG, os.O_NONBLOCK), numpy (os.uname) and torch
(os.register_at_fork) cannot do without on Linux.
"""

import os
import select
import signal
import socket
import sys
import time

MODULES = ("curses", "fcntl", "grp", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty")
HIDDEN = {
    os: (
        "O_DIRECTORY",
        "O_NOFOLLOW",
        "O_SYNC",
        "chown",
        "chroot",
        "confstr",
        "copy_file_range",
        "ctermid",
        "eventfd",
        "fchdir",
        "fchmod",
        "fchown",
        "fdatasync",
        "fork",
        "forkpty",
        "fstatvfs",
        "getegid",
        "geteuid",
        "getgid",
        "getgroups",
        "getloadavg",
        "getpgid",
        "getpgrp",
        "getpriority",
        "getsid",
        "getuid",
        "killpg",
        "lchown",
        "lockf",
        "memfd_create",
        "mkfifo",
        "mknod",
        "nice",
        "openpty",
        "pathconf",
        "pidfd_open",
        "pipe2",
        "posix_fadvise",
        "posix_fallocate",
        "posix_spawn",
        "posix_spawnp",
        "pread",
        "preadv",
        "pwrite",
        "pwritev",
        "readv",
        "sched_getaffinity",
        "sched_getparam",
        "sched_getscheduler",
        "sched_setaffinity",
        "sched_setscheduler",
        "sched_yield",
        "sendfile",
        "set_blocking",
        "setegid",
        "seteuid",
        "setgid",
        "setpgid",
        "setpgrp",
        "setpriority",
        "setsid",
        "setuid",
        "splice",
        "statvfs",
        "sync",
        "sysconf",
        "tcgetpgrp",
        "tcsetpgrp",
        "ttyname",
        "wait",
        "wait3",
        "wait4",
        "waitid",
        "writev",
    ),
    select: tuple(name for name in dir(select) if name.lower().startswith(("poll", "epoll"))),
    signal: (
        "ITIMER_PROF",
        "ITIMER_REAL",
        "ITIMER_VIRTUAL",
        "SIGALRM",
        "SIGCHLD",
        "SIGCONT",
        "SIGHUP",
        "SIGKILL",
        "SIGPIPE",
        "SIGQUIT",
        "SIGSTOP",
        "SIGTSTP",
        "SIGUSR1",
        "SIGUSR2",
        "SIGWINCH",
        "SIG_BLOCK",
        "SIG_SETMASK",
        "SIG_UNBLOCK",
        "alarm",
        "getitimer",
        "pause",
        "pthread_kill",
        "pthread_sigmask",
        "setitimer",
        "siginterrupt",
        "sigpending",
        "sigtimedwait",
        "sigwait",
        "sigwaitinfo",
    ),
    socket: ("AF_UNIX", "CMSG_LEN", "SCM_RIGHTS", "recv_fds", "send_fds"),
    time: tuple(name for name in dir(time) if name.startswith(("CLOCK_", "clock_", "pthread_", "tzset"))),
}

for module in MODULES:
    sys.modules[module] = None
for owner, names in HIDDEN.items():
    for name in names:
        if hasattr(owner, name):
            delattr(owner, name)
