/* The kernel of fleet.c, included once for each vector width: LANES robots a vector, NAME(x) the variant's names.
 *
 * The rod, its loads and position Verlet are PyElastica's (arm.py, loads.py), with the two half drifts between time
 * steps merged. One sweep along the rod is one time step. Its stages follow each other a few elements apart: A drift
 * and geometry of element k, B curvature between k - 1 and k, C actuators and stress, D kick. A short ring holds what a
 * stage passes to the next. No lane reads another one, so a robot's numbers do not depend on its place.
 *
 * A, B and C are in two parts, 1 and 2, with other stages in between: the square roots and divisions of the first part
 * take long, and a processor that cannot look far enough ahead would wait for them.
 *
 * Three short cuts in the algebra, exact but for rounding. With N = stress / stretch + actuator force (material frame):
 * the force between nodes is Q^T N, and the couple of both is rest length * (strain + e3) x N. What transport of the
 * angular momentum of a disk (J, J, 2 J) and stretching give, divided by J, is (-w1 w2, w0 w2, 0) + stretch rate * w.
 * The bending couple and the actuators' share the same differences, so they are added first.
 *
 * More than 300 lines: one file is what fleet.c includes once for each vector width. */

typedef double NAME(vector) __attribute__((vector_size(8 * LANES)));
typedef int64_t NAME(mask) __attribute__((vector_size(8 * LANES)));
#define V NAME(vector)
#define M NAME(mask)
#define INLINE static inline __attribute__((always_inline))
#define DOT(a, b) ((a)[0] * (b)[0] + (a)[1] * (b)[1] + (a)[2] * (b)[2])

struct NAME(element) {
  V position[3], velocity[3], director[9], omega[3], slip[2]; /* slip: of the friction with the element before */
};

struct NAME(drive) {
  V goal, valve, force, place; /* N at weight 1; place along the actuator's axis: half of it, at rest */
};

struct NAME(work) {
  V length, inverse, radius, strain[3], stress[3], drag[3], rate; /* A; strain is sigma + e3 */
  V kappa[3], couple[3], curl[3], slope;                          /* B, with the element before; kappa is halved */
  V pair[3], force[3], front[3], back[3], moment[3], turn[3];     /* C; forces on the node before and the one after */
};

struct NAME(passed) {
  V d[3], v[3];    /* from A1 to A2: between the nodes, and the sum of their velocities */
  V z[3], inverse; /* from B1 to B2: twice the axis of the rotation times its sine; over the mean length */
  V pull[MOST_ACTUATORS][3],
      share[MOST_ACTUATORS]; /* from C1 to C2: an actuator's stretched line; its force over that */
};

#define ELEMENT struct NAME(element)
#define WORK struct NAME(work)
#define DRIVE struct NAME(drive)
#define PASSED struct NAME(passed)
#define COUNT(p, second) ((second) == ANYWHERE ? (int)(p)->actuators : ACTUATORS)

INLINE V NAME(root)(V x) {
#if LANES == 8
  return (V)_mm512_sqrt_pd((__m512d)x);
#elif LANES == 4
  return (V)_mm256_sqrt_pd((__m256d)x);
#else
  for (int i = 0; i < LANES; i++) {
    x[i] = __builtin_sqrt(x[i]);
  }
  return x;
#endif
}

/* Q <- exp(w) Q: sin(x)/x and (1 - cos x)/x^2 as series in x^2 = t; relative error below t^4 / 362880, which is 1e-17
 * up to 0.04 rad a time step. */
INLINE void NAME(rotate)(V *restrict q, const V *restrict w) {
  V t = DOT(w, w), t2 = t * t;
  V s = (1.0 + t * (-1.0 / 6)) + t2 * (1.0 / 120 + t * (-1.0 / 5040));
  V c = (0.5 + t * (-1.0 / 24)) + t2 * (1.0 / 720 + t * (-1.0 / 40320));
  V cx = c * w[0], cy = c * w[1], cz = c * w[2];
  V sx = s * w[0], sy = s * w[1], sz = s * w[2];
  V xx = cx * w[0], yy = cy * w[1], zz = cz * w[2];
  V xy = cx * w[1], xz = cx * w[2], yz = cy * w[2];
  for (int j = 0; j < 3; j++) {
    V a = q[j], b = q[3 + j], d = q[6 + j];
    q[j] = (1.0 - (yy + zz)) * a + (xy + sz) * b + (xz - sy) * d;
    q[3 + j] = (xy - sz) * a + (1.0 - (xx + zz)) * b + (yz + sx) * d;
    q[6 + j] = (xz + sy) * a + (yz - sx) * b + (1.0 - (xx + yy)) * d;
  }
}

/* A1: drift of the element and of the node after it by a time step; length. */
INLINE void NAME(lengths)(const struct parameters *p, ELEMENT *e, WORK *o, PASSED *between) {
  V d[3], dv[3];
  for (int i = 0; i < 3; i++) {
    e[1].position[i] += e[1].velocity[i];
    d[i] = e[1].position[i] - e[0].position[i];
    dv[i] = e[1].velocity[i] - e[0].velocity[i];
    between->d[i] = d[i];
    between->v[i] = e[1].velocity[i] + e[0].velocity[i];
  }
  V length = NAME(root)(DOT(d, d)) + p->tiny;
  V inverse = 1.0 / length;
  o->rate = DOT(d, dv) * (inverse * inverse);
  o->length = length;
  o->inverse = inverse;
  o->radius = NAME(root)(inverse);
}

/* A2: rotation of the element by a time step; strain, stress, damping and drag. */
INLINE void NAME(strains)(const struct parameters *p, double stiffness, ELEMENT *e, WORK *o, const PASSED *between) {
  V u[3];
  NAME(rotate)(e->director, e->omega);
  for (int i = 0; i < 3; i++) {
    const V *row = e->director + 3 * i;
    o->strain[i] = DOT(row, between->d);
    u[i] = DOT(row, between->v);
  }
  V firm = stiffness * o->inverse;
  V shear = p->shear * firm;
  o->stress[0] = shear * o->strain[0];
  o->stress[1] = shear * o->strain[1];
  o->stress[2] = p->stretch * firm * (o->strain[2] - 1.0);
  V damping = p->half_damping * o->length;
  V section = o->radius * o->length;
  V across = p->drag[0] * section, along = p->drag[1] * section;
  for (int i = 0; i < 3; i++) {
    V speed = (V)((M)u[i] & INT64_MAX);
    o->drag[i] = (damping - (i < 2 ? across : along) * speed) * u[i];
  }
}

/* B1: rotation from element a to b. */
INLINE void NAME(bends)(const ELEMENT *a, const ELEMENT *b, const WORK *oa, const WORK *o, PASSED *between) {
  const V *f = a->director, *g = b->director;
  V *z = between->z;
  between->inverse = 2.0 / (oa->length + o->length);
  z[0] = DOT(g + 3, f + 6) - DOT(g + 6, f + 3);
  z[1] = DOT(g + 6, f) - DOT(g, f + 6);
  z[2] = DOT(g, f + 3) - DOT(g + 3, f);
}

/* B2: curvature before an element; asin(x)/x / 4 as a series in 4 x^2 = t. Relative error below 2e-15 for 0.3 rad
 * between two elements, 2e-12 for 0.4, 2e-10 for 0.5; a robot that bends more sharply is made non-finite. */
INLINE void NAME(curvature)(const struct parameters *p, double rigidity, const WORK *oa, WORK *o,
                            const PASSED *between) {
  const V *z = between->z;
  V inverse = between->inverse;
  V t = DOT(z, z), t2 = t * t, t4 = t2 * t2;
#define C(n, a) ((a) / (4.0 * (1L << 2 * (n))))
  V s0 = (C(0, 1.0) + t * C(1, 1.0 / 6)) + t2 * (C(2, 3.0 / 40) + t * C(3, 5.0 / 112));
  V s1 = (C(4, 35.0 / 1152) + t * C(5, 63.0 / 2816)) + t2 * (C(6, 231.0 / 13312) + t * C(7, 143.0 / 10240));
  V s2 = (C(8, 6435.0 / 557056) + t * C(9, 12155.0 / 1245184)) +
         t2 * (C(10, 46189.0 / 5505024) + t * C(11, 88179.0 / 12058624));
#undef C
  V c = (V)((M)(s0 + t4 * (s1 + t4 * s2)) | (M)(t > 0.92));
  V cube = inverse * inverse * (rigidity * inverse);
  V bend = p->bend[0] * cube, twist = p->bend[1] * cube;
  V radii = oa->radius + o->radius;
  for (int i = 0; i < 3; i++) {
    o->kappa[i] = c * z[i];
    o->couple[i] = (i < 2 ? bend : twist) * o->kappa[i];
    o->curl[i] = radii * o->kappa[i];
  }
  o->slope = (o->radius - oa->radius) * inverse;
}

/* C1: the force of each actuator of an element. The second one is along axis `second`, or all are anywhere. */
INLINE void NAME(pulls)(const struct parameters *p, int second, const DRIVE *drive, const WORK *o, const WORK *after,
                        PASSED *between) {
  V curl[3], slope = o->slope + after->slope;
  for (int i = 0; i < 3; i++) {
    curl[i] = o->curl[i] + after->curl[i];
  }
  for (int a = 0; a < COUNT(p, second); a++) {
    int axis = a == 1 ? second : 0;
    V x = drive[a].place, *t = between->pull[a];
    if (second == ANYWHERE) {
      double px = p->places[2 * a], py = p->places[2 * a + 1];
      t[0] = o->strain[0] + (slope * px - curl[2] * py);
      t[1] = o->strain[1] + (slope * py + curl[2] * px);
      t[2] = o->strain[2] + (curl[0] * py - curl[1] * px);
    } else {
      t[axis] = o->strain[axis] + slope * x;
      t[1 - axis] = axis ? o->strain[0] - curl[2] * x : o->strain[1] + curl[2] * x;
      t[2] = axis ? o->strain[2] + curl[0] * x : o->strain[2] - curl[1] * x;
    }
    V local = NAME(root)(DOT(t, t));
    V weight = (p->weight[1] + local * (p->weight[2] + local * p->weight[3])) + p->weight[0] / local;
    M slack = (M)(weight < 0.0) | (M)(local > p->longest); /* weight: over local, which is positive */
    between->share[a] = (V)((M)(drive[a].force * o->inverse * weight) & ~slack);
  }
}

/* What the friction of the wall adds to the bending couple m: a spring whose other end slips. */
INLINE void NAME(rub)(const struct parameters *p, const V *kappa, V *slip, V *m) {
  const V one = (V){0} + 1.0;
  V d0 = kappa[0] - slip[0], d1 = kappa[1] - slip[1];
  V far = NAME(root)(d0 * d0 + d1 * d1);
  M slips = (M)(far > p->friction_curvature);
  V held = (V)(((M)(p->friction_curvature / far) & slips) | ((M)one & ~slips));
  d0 *= held;
  d1 *= held;
  slip[0] = (V)(((M)(kappa[0] - d0) & slips) | ((M)slip[0] & ~slips));
  slip[1] = (V)(((M)(kappa[1] - d1) & slips) | ((M)slip[1] & ~slips));
  m[0] += p->friction * d0;
  m[1] += p->friction * d1;
}

/* C2: forces on the two nodes, and the couple towards the element before. */
INLINE void NAME(forces)(const struct parameters *p, int rubs, int second, const DRIVE *drive, ELEMENT *e,
                         const WORK *before, WORK *o, const PASSED *between) {
  const V *q = e->director;
  V pair[3] = {{0}}, n[3], m[3];
  for (int i = 0; i < 3; i++) {
    n[i] = o->stress[i];
  }
  for (int a = 0; a < COUNT(p, second); a++) {
    V y = o->radius * drive[a].place, t[3];
    for (int i = 0; i < 3; i++) {
      t[i] = between->pull[a][i] * between->share[a];
      n[i] += t[i];
    }
    if (second == ANYWHERE) {
      V x = o->radius * p->places[2 * a];
      y = o->radius * p->places[2 * a + 1];
      pair[0] += y * t[2];
      pair[1] -= x * t[2];
      pair[2] += x * t[1] - y * t[0];
    } else if (a == 1 && second) {
      pair[0] += y * t[2];
      pair[2] -= y * t[0];
    } else {
      pair[1] -= y * t[2];
      pair[2] += y * t[1];
    }
  }
  for (int i = 0; i < 3; i++) {
    V x = o->drag[0] + n[0], y = o->drag[1] + n[1], z = o->drag[2] + n[2];
    o->front[i] = q[i] * x + q[3 + i] * y + q[6 + i] * z;
    x = o->drag[0] - n[0], y = o->drag[1] - n[1], z = o->drag[2] - n[2];
    o->back[i] = q[i] * x + q[3 + i] * y + q[6 + i] * z;
    o->force[i] = n[i];
    o->pair[i] = pair[i];
    m[i] = o->couple[i] + (before->pair[i] + pair[i]);
  }
  const V *k = o->kappa;
  if (rubs) {
    NAME(rub)(p, k, e->slip, m);
  }
  for (int i = 0; i < 3; i++) {
    o->moment[i] = m[i];
  }
  o->turn[0] = k[1] * m[2] - k[2] * m[1];
  o->turn[1] = k[2] * m[0] - k[0] * m[2];
  o->turn[2] = k[0] * m[1] - k[1] * m[0];
}

/* D: kick of the element and of the node before it. */
INLINE void NAME(kick)(const struct parameters *p, double mobility, ELEMENT *e, const WORK *before, const WORK *o,
                       const WORK *after) {
  const V *s = o->strain, *n = o->force;
  V w[3] = {e->omega[0], e->omega[1], e->omega[2]};
  V spin = p->gyration[0] * w[2], square = o->length * o->length;
  V turn[2], fade[2];
  for (int i = 0; i < 2; i++) {
    turn[i] = p->turn_kick[i] * o->length;
    fade[i] = p->gyration[i] * o->rate - p->fade_kick[i] * square;
  }
  V torque[3] = {s[1] * n[2] - s[2] * n[1], s[2] * n[0] - s[0] * n[2], s[0] * n[1] - s[1] * n[0]};
  for (int i = 0; i < 3; i++) {
    V t = (o->turn[i] + after->turn[i]) + (after->moment[i] - o->moment[i]) + torque[i];
    e->omega[i] += turn[i / 2] * t + fade[i / 2] * w[i];
    e->velocity[i] += mobility * (before->back[i] + o->front[i]);
  }
  e->omega[0] -= spin * w[1];
  e->omega[1] += spin * w[0];
  e->velocity[2] += p->gravity_kick;
}

/* The data of one turn of the sweep, at the front element k. */
struct NAME(front) {
  const struct parameters *parameters;
  ELEMENT *elements;
  WORK *ring;
  const DRIVE *drive; /* of the module of element k - LAG_C */
  int count;
};

/* All stages, each on its element if `inside` or if the rod has that element. Within a turn A1, A2, B1, B2 need this
 * order, and C1, C2; the rest of the order is for speed. With AVX-512 all of A and B first is a tenth faster. */
INLINE void NAME(turn)(const struct NAME(front) * f, int inside, int rubs, int second, int k) {
#define AT(k) (f->ring + ((k) & (RING - 1)))
  const struct parameters *p = f->parameters;
  ELEMENT *e = f->elements;
  PASSED between;
  int c = k - LAG_C, d = k - LAG_D;
  int has_a = inside || k < f->count, has_b = inside || (k > 0 && k < f->count);
  int has_c = inside || (c >= 0 && c < f->count), has_d = inside || d > 0;
  int early = LANES == 8;
  if (has_a) {
    NAME(lengths)(p, e + k, AT(k), &between);
  }
  if (has_a && early) {
    NAME(strains)(p, p->stiffness[k], e + k, AT(k), &between);
  }
  if (has_b && early) {
    NAME(bends)(e + k - 1, e + k, AT(k - 1), AT(k), &between);
    NAME(curvature)(p, p->rigidity[k - 1], AT(k - 1), AT(k), &between);
  }
  if (has_c) {
    NAME(pulls)(p, second, f->drive, AT(c), AT(c + 1), &between);
  }
  if (has_a && !early) {
    NAME(strains)(p, p->stiffness[k], e + k, AT(k), &between);
  }
  if (has_b && !early) {
    NAME(bends)(e + k - 1, e + k, AT(k - 1), AT(k), &between);
  }
  if (has_d) {
    NAME(kick)(p, p->mobility[d], e + d, AT(d - 1), AT(d), AT(d + 1));
  }
  if (has_b && !early) {
    NAME(curvature)(p, p->rigidity[k - 1], AT(k - 1), AT(k), &between);
  }
  if (has_c) {
    NAME(forces)(p, rubs, second, f->drive, e + c, AT(c - 1), AT(c), &between);
  }
  if (!inside && k == f->count) {
    *AT(k) = (WORK){0}; /* nothing bends after the last element */
  }
  if (!inside && c == 0) {
    for (int i = 0; i < 3; i++) {
      AT(0)->moment[i] = AT(0)->turn[i] = (V){0};
    }
  }
}

/* One time step: drift, then kick. The first node and element are clamped: at rest, and never kicked. */
INLINE void NAME(sweep)(const struct parameters *p, int rubs, int second, int elements, int per_module,
                        const DRIVE *drive, ELEMENT *e) {
  WORK ring[RING];
  struct NAME(front) front = {p, e, ring, drive, elements}, *f = &front;
  int left = per_module + LAG_C; /* turns until stage C comes to the next module */
  *AT(0) = *AT(-1) = (WORK){0};  /* nothing bends before the first element */
  for (int k = 0; k < elements + LAG_D; k++) {
    if (left-- == 0) {
      front.drive += COUNT(p, second);
      left = per_module - 1;
    }
    if (k > LAG_D && k < elements) {
      NAME(turn)(f, 1, rubs, second, k);
    } else {
      NAME(turn)(f, 0, rubs, second, k);
    }
  }
  for (int i = 0; i < 3; i++) {
    e[elements].velocity[i] += p->mobility[elements] * AT(elements - 1)->back[i];
  }
  e[elements].velocity[2] += p->gravity_kick;
#undef AT
}

/* Valve after its set-point, chamber after its valve. */
INLINE void NAME(follow)(const struct parameters *p, int drives, DRIVE *drive) {
  for (int i = 0; i < drives; i++) {
    drive[i].valve += p->valve_share * (drive[i].goal - drive[i].valve);
    drive[i].force += p->chamber_share * (drive[i].valve - drive[i].force);
  }
}

/* Drift of all elements by `part` of a time step. */
static void NAME(drift)(int elements, ELEMENT *e, double part) {
  for (int k = 0; k < elements; k++) {
    V w[3];
    for (int i = 0; i < 3; i++) {
      w[i] = part * e[k].omega[i];
      e[k + 1].position[i] += part * e[k + 1].velocity[i];
    }
    NAME(rotate)(e[k].director, w);
  }
}

static void NAME(advance)(const struct parameters *p, int block, int modules, int per_module, double *drives,
                          double *state, long steps) {
  int elements = modules * per_module;
  ELEMENT *e = (ELEMENT *)state + (long)block * (elements + 1);
  int count = modules * COUNT(p, p->second);
  DRIVE *drive = (DRIVE *)drives + (long)block * count;
  if (steps <= 0) {
    return;
  }
  NAME(drift)(elements, e, -0.5); /* every sweep drifts by a whole time step, the first one by half */
  for (long s = 0; s < steps; s++) {
    if (p->lags) {
      NAME(follow)(p, count, drive);
    }
    if (p->second == ANYWHERE) { /* without friction the same sweep adds zeros */
      NAME(sweep)(p, 1, ANYWHERE, elements, per_module, drive, e);
    } else if (p->friction > 0.0 && p->second) {
      NAME(sweep)(p, 1, 1, elements, per_module, drive, e);
    } else if (p->friction > 0.0) {
      NAME(sweep)(p, 1, 0, elements, per_module, drive, e);
    } else if (p->second) {
      NAME(sweep)(p, 0, 1, elements, per_module, drive, e);
    } else {
      NAME(sweep)(p, 0, 0, elements, per_module, drive, e);
    }
  }
  NAME(drift)(elements, e, 0.5);
}

/* The core's peak rate, for the benchmark: 12 independent chains of multiply-adds. */
static double NAME(peak)(long rounds) {
  V x[12], factor = (V){0} + 0.999999;
  for (int i = 0; i < 12; i++) {
    x[i] = factor * (double)i;
  }
  for (long r = 0; r < rounds; r++) {
    for (int i = 0; i < 12; i++) {
      x[i] = x[i] * factor + factor;
    }
  }
  for (int i = 1; i < 12; i++) {
    x[0] += x[i];
  }
  return x[0][0];
}

#undef V
#undef M
#undef INLINE
#undef DOT
#undef ELEMENT
#undef WORK
#undef DRIVE
#undef PASSED
#undef COUNT
