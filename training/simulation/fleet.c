/* Many robots at once: the compiled half of fleet.py. Robots are the lanes of SIMD vectors; the kernel itself is in
 * fleet_kernel.h, and this file compiles it once for each vector width and reports which of them the processor has. */

#include <stdint.h>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

/* Actuators that act on a module at a time: two along the directors, or as many as `struct parameters` says, anywhere
 * around the section. */
enum { ACTUATORS = 2, ANYWHERE = 2, MOST_ACTUATORS = 12 };

/* The modules of a robot; three arrays hold the differences between its elements. fleet.py fills it in, field by field.
 * Units: the rest length of an element, the time step, and newton; so a velocity is in rest lengths a time step. */
struct parameters {
  int64_t second;        /* 0 or 1: the director that the second actuator is along; the first is along 0; or ANYWHERE */
  int64_t actuators;     /* of a module, where they are ANYWHERE */
  int64_t lags;          /* whether the actuators follow their goal late */
  double tiny;           /* added to the length of an element, as PyElastica does */
  double shear, stretch; /* stiffness of a section */
  double bend[2];        /* and twist: couple of half a curvature, at rigidity 1 */
  double half_damping;   /* negative; on the sum of an element's two node velocities; each node takes half */
  double drag[2];        /* across and along; on that sum squared, half of it likewise */
  double weight[4];      /* of an actuator's stress, powers of its stretch */
  double longest;        /* stretch beyond which an actuator is slack */
  double valve_share, chamber_share;   /* of the way to go, a time step */
  double friction, friction_curvature; /* of the wall: couple of half a curvature, and the half where it slips */
  double gravity_kick;                 /* velocity of a time step */
  double gyration[2];                  /* time steps of the rotational kick, of axes 0 and 1 and of axis 2 */
  double turn_kick[2];                 /* angular velocity of a unit torque, likewise */
  double fade_kick[2];                 /* damping of the rotation at rest length, likewise */
  const double *mobility;              /* (elements + 1): velocity that a unit force gives a node in a time step */
  const double *stiffness;             /* (elements): of shear and stretch, over that of the robot */
  const double *rigidity;              /* (elements - 1): of bend and twist in a Voronoi domain, likewise */
  const double *places;                /* (actuators, 2): along both directors, halves at rest, where ANYWHERE */
};

/* Elements a stage stays behind the first one, so that the stages of one turn of the loop do not wait for each other
 * (four modules, Zen 5: 0.65 us a step against 0.84 for the closest possible, 1 and 2). */
enum { LAG_C = 2, LAG_D = 4, RING = 8 };

#define LANES 2
#define NAME(x) x##_plain
#include "fleet_kernel.h"
#undef LANES
#undef NAME

#if defined(__x86_64__)

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2,fma")
#endif
#define LANES 4
#define NAME(x) x##_avx2
#include "fleet_kernel.h"
#undef LANES
#undef NAME
#if defined(__clang__)
#pragma clang attribute pop
#pragma clang attribute push(__attribute__((target("avx512f,avx512dq,avx512vl,avx2,fma"))), apply_to = function)
#else
#pragma GCC pop_options
#pragma GCC push_options
#pragma GCC target("avx512f,avx512dq,avx512vl,avx2,fma")
#endif
#define LANES 8
#define NAME(x) x##_avx512
#include "fleet_kernel.h"
#undef LANES
#undef NAME
#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

#endif

/* Lanes (robots in a block) of a variant: 0 plain C, 1 AVX2, 2 AVX-512. 0 where this processor cannot run it. */
int fleet_lanes(int variant) {
  if (variant == 0) {
    return 2;
  }
#if defined(__x86_64__)
  __builtin_cpu_init();
  int avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (variant == 1 && avx2) {
    return 4;
  }
  if (variant == 2 && avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl")) {
    return 8;
  }
#endif
  return 0;
}

int fleet_parameters_bytes(void) { return (int)sizeof(struct parameters); }

/* Advances `blocks` blocks of robots of `modules` modules by `steps` time steps.
 *
 * drive (blocks, modules, actuators, 4, lanes): struct drive.
 * state (blocks, elements + 1, 20, lanes): struct element, k beside the node before it; the last node has no element.
 * Both start on a multiple of 8 * lanes bytes.
 */
void fleet_advance(int variant, const struct parameters *parameters, int blocks, int modules, int per_module,
                   double *drive, double *state, long steps) {
  for (int b = 0; b < blocks; b++) {
    switch (variant) {
      case 0:
        advance_plain(parameters, b, modules, per_module, drive, state, steps);
        break;
#if defined(__x86_64__)
      case 1:
        advance_avx2(parameters, b, modules, per_module, drive, state, steps);
        break;
      case 2:
        advance_avx512(parameters, b, modules, per_module, drive, state, steps);
        break;
#endif
    }
  }
}

/* rounds * 12 * lanes multiply-adds; the result is returned so that the compiler does not remove them. */
double fleet_peak(int variant, long rounds) {
#if defined(__x86_64__)
  if (variant == 2) {
    return peak_avx512(rounds);
  }
  if (variant == 1) {
    return peak_avx2(rounds);
  }
#endif
  return variant == 0 ? peak_plain(rounds) : 0.0;
}
