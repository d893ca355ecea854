/* Preloaded into a process, this changes its wall clock by up to an hour in both directions, about three times a
 * second; the other clocks stay unchanged. For row 27 of the failure matrix. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <sys/time.h>
#include <time.h>

static int (*real_gettime)(clockid_t, struct timespec *);

static void find(void) {
  if (!real_gettime) {
    real_gettime = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
  }
}

/* Changes every 300 ms; the same for every caller. */
static int64_t offset_s(void) {
  struct timespec now;
  real_gettime(CLOCK_MONOTONIC, &now);
  uint32_t slot = (uint32_t)(now.tv_sec * 10 / 3 + now.tv_nsec / 300000000);
  return (int64_t)(slot * 2654435761u % 7201u) - 3600;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
  find();
  int failed = real_gettime(clock, now);
  if (!failed && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) {
    now->tv_sec += offset_s();
  }
  return failed;
}

int gettimeofday(struct timeval *now, void *zone) {
  (void)zone;
  struct timespec at;
  clock_gettime(CLOCK_REALTIME, &at);
  now->tv_sec = at.tv_sec;
  now->tv_usec = at.tv_nsec / 1000;
  return 0;
}

time_t time(time_t *now) {
  struct timespec at;
  clock_gettime(CLOCK_REALTIME, &at);
  if (now) {
    *now = at.tv_sec;
  }
  return at.tv_sec;
}
