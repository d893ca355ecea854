/* The kernel of fleet.c, included once for each vector width: LANES robots a vector, NAME(x) the variant's names.
 *
 * The rod, its loads and position Verlet are PyElastica's (arm.py, loads.py), with the two half drifts between time
 * steps merged. One sweep along the rod is one time step. Its stages follow each other a few elements apart: A drift
 * and geometry of element k, B curvature between k - 1 and k, C actuators and stress, D kick. What a stage hands to the
 * next stands in a short ring. No lane ever looks at another one, so a robot's numbers do not depend on its place.
 *
 * Three short cuts in the algebra, exact but for rounding. With N = stress / stretch + actuator force (material frame):
 * the force between nodes is Q^T N, and the couple of both is rest length * (strain + e3) x N. What transport of the
 * angular momentum of a disk (J, J, 2 J) and stretching give, divided by J, is (-w1 w2, w0 w2, 0) + stretch rate * w.
 * The bending couple and the actuators' share the same differences, so they are added first.
 */

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
    V goal, valve, force, place; /* N at weight 1; place along the actuator's axis over the current radius */
};

struct NAME(work) {
    V length, inverse, radius, strain[3], stress[3], drag[3], rate; /* A; strain is sigma + e3 */
    V kappa[3], couple[3], curl[3], slope;                          /* B, with the element before; kappa is halved */
    V pair[3], force[3], front[3], back[3], moment[3], turn[3];     /* C; forces on the node before and the one after */
};

#define ELEMENT struct NAME(element)
#define WORK struct NAME(work)
#define DRIVE struct NAME(drive)

INLINE V NAME(root)(V x)
{
#if LANES == 8
    return (V)_mm512_sqrt_pd((__m512d)x);
#elif LANES == 4
    return (V)_mm256_sqrt_pd((__m256d)x);
#else
    for (int i = 0; i < LANES; i++)
        x[i] = __builtin_sqrt(x[i]);
    return x;
#endif
}

/* Q <- exp(w) Q: sin(x)/x and (1 - cos x)/x^2 as series in x^2 = t; relative error below t^4 / 362880, which is 1e-17 up
 * to 0.04 rad a time step. */
INLINE void NAME(rotate)(V *restrict q, const V *restrict w)
{
    V t = DOT(w, w);
    V s = 1.0 + t * (-1.0 / 6 + t * (1.0 / 120 + t * (-1.0 / 5040)));
    V c = 0.5 + t * (-1.0 / 24 + t * (1.0 / 720 + t * (-1.0 / 40320)));
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

/* A: drift of the element and of the node after it by a time step; length, strain, stress, damping and drag. */
INLINE void NAME(geometry)(const struct plant *p, double stiffness, ELEMENT *e, WORK *o)
{
    V d[3], dv[3], v[3], u[3];
    for (int i = 0; i < 3; i++) {
        e[1].position[i] += e[1].velocity[i];
        d[i] = e[1].position[i] - e[0].position[i];
        dv[i] = e[1].velocity[i] - e[0].velocity[i];
        v[i] = e[1].velocity[i] + e[0].velocity[i];
    }
    NAME(rotate)(e->director, e->omega);
    V length = NAME(root)(DOT(d, d)) + p->tiny;
    V inverse = 1.0 / length;
    V radius = NAME(root)(inverse);
    for (int i = 0; i < 3; i++) {
        const V *row = e->director + 3 * i;
        o->strain[i] = DOT(row, d);
        u[i] = DOT(row, v);
    }
    V firm = stiffness * inverse;
    V shear = p->shear * firm;
    o->stress[0] = shear * o->strain[0];
    o->stress[1] = shear * o->strain[1];
    o->stress[2] = p->stretch * firm * (o->strain[2] - 1.0);
    V damping = p->half_damping * length;
    V section = radius * length;
    V across = p->drag[0] * section, along = p->drag[1] * section;
    for (int i = 0; i < 3; i++) {
        V speed = (V)((M)u[i] & INT64_MAX);
        o->drag[i] = (damping - (i < 2 ? across : along) * speed) * u[i];
    }
    o->rate = DOT(d, dv) * (inverse * inverse);
    o->length = length;
    o->inverse = inverse;
    o->radius = radius;
}

/* B: curvature between the elements a and b, b's work; asin(x)/x / 4 as a series in 4 x^2 = t. Relative error below 2e-15
 * for 0.3 rad between two elements, 2e-12 for 0.4, 2e-10 for 0.5; a robot that bends more sharply is made non-finite. */
INLINE void NAME(curvature)(const struct plant *p, double rigidity, const ELEMENT *a, const ELEMENT *b, const WORK *oa,
                            WORK *o)
{
    const V *f = a->director, *g = b->director;
    V z[3];
    z[0] = DOT(g + 3, f + 6) - DOT(g + 6, f + 3);
    z[1] = DOT(g + 6, f) - DOT(g, f + 6);
    z[2] = DOT(g, f + 3) - DOT(g + 3, f);
    V t = DOT(z, z), t2 = t * t, t4 = t2 * t2;
#define C(n, a) ((a) / (4.0 * (1L << 2 * (n))))
    V s0 = (C(0, 1.0) + t * C(1, 1.0 / 6)) + t2 * (C(2, 3.0 / 40) + t * C(3, 5.0 / 112));
    V s1 = (C(4, 35.0 / 1152) + t * C(5, 63.0 / 2816)) + t2 * (C(6, 231.0 / 13312) + t * C(7, 143.0 / 10240));
    V s2 = (C(8, 6435.0 / 557056) + t * C(9, 12155.0 / 1245184))
           + t2 * (C(10, 46189.0 / 5505024) + t * C(11, 88179.0 / 12058624));
#undef C
    V c = (V)((M)(s0 + t4 * (s1 + t4 * s2)) | (M)(t > 0.92));
    V inverse = 2.0 / (oa->length + o->length);
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

/* One actuator of an element: its force is added to n, its couple about the centre line to pair. */
INLINE void NAME(pull)(const struct plant *p, int axis, const DRIVE *drive, const V *curl, V slope, const WORK *o,
                       V *n, V *pair)
{
    V x = drive->place, y = o->radius * x, t[3];
    t[axis] = o->strain[axis] + slope * x;
    t[1 - axis] = axis ? o->strain[0] - curl[2] * x : o->strain[1] + curl[2] * x;
    t[2] = axis ? o->strain[2] + curl[0] * x : o->strain[2] - curl[1] * x;
    V local = NAME(root)(DOT(t, t));
    V weight = p->weight[0] + local * (p->weight[1] + local * (p->weight[2] + local * p->weight[3]));
    M slack = (M)(weight < 0.0) | (M)(local > p->longest);
    V f = (V)((M)(drive->force * o->inverse * weight / local) & ~slack);
    for (int i = 0; i < 3; i++) {
        t[i] *= f;
        n[i] += t[i];
    }
    if (axis) {
        pair[0] += y * t[2];
        pair[2] -= y * t[0];
    } else {
        pair[1] -= y * t[2];
        pair[2] += y * t[1];
    }
}

/* What the friction of the wall adds to the bending couple m: a spring whose other end slips. */
INLINE void NAME(rub)(const struct plant *p, const V *kappa, V *slip, V *m)
{
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

/* C: actuators, forces on the two nodes, and the couple towards the element before. */
INLINE void NAME(forces)(const struct plant *p, int rubs, const DRIVE *drive, ELEMENT *e, const WORK *before, WORK *o,
                         const WORK *after)
{
    const V *q = e->director;
    V curl[3], pair[3] = {{0}}, n[3], m[3];
    for (int i = 0; i < 3; i++) {
        curl[i] = o->curl[i] + after->curl[i];
        n[i] = o->stress[i];
    }
    V slope = o->slope + after->slope;
    for (int a = 0; a < p->actuators; a++)
        if (p->axis[a])
            NAME(pull)(p, 1, drive + a, curl, slope, o, n, pair);
        else
            NAME(pull)(p, 0, drive + a, curl, slope, o, n, pair);
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
    if (rubs)
        NAME(rub)(p, k, e->slip, m);
    for (int i = 0; i < 3; i++)
        o->moment[i] = m[i];
    o->turn[0] = k[1] * m[2] - k[2] * m[1];
    o->turn[1] = k[2] * m[0] - k[0] * m[2];
    o->turn[2] = k[0] * m[1] - k[1] * m[0];
}

/* D: kick of the element and of the node before it. */
INLINE void NAME(kick)(const struct plant *p, double mobility, ELEMENT *e, const WORK *before, const WORK *o,
                       const WORK *after)
{
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

/* One time step: drift, then kick. The first node and element are clamped: at rest, and never kicked. */
INLINE void NAME(sweep)(const struct plant *p, int rubs, int elements, int per_module, const DRIVE *drive, ELEMENT *e)
{
    const double *mobility = p->mobility, *stiffness = p->stiffness, *rigidity = p->rigidity;
    WORK ring[RING];
#define AT(k) (ring + ((k) & (RING - 1)))
    *AT(0) = *AT(-1) = (WORK){0}; /* nothing bends before the first element */
    for (int k = 0; k < elements + LAG_D; k++) {
        int c = k - LAG_C, d = k - LAG_D;
        if (k < elements)
            NAME(geometry)(p, stiffness[k], e + k, AT(k));
        if (k > 0 && k < elements)
            NAME(curvature)(p, rigidity[k - 1], e + k - 1, e + k, AT(k - 1), AT(k));
        else if (k == elements)
            *AT(k) = (WORK){0}; /* nor after the last one */
        if (c >= 0 && c < elements)
            NAME(forces)(p, rubs, drive + p->actuators * (c / per_module), e + c, AT(c - 1), AT(c), AT(c + 1));
        if (c == 0)
            for (int i = 0; i < 3; i++)
                AT(0)->moment[i] = AT(0)->turn[i] = (V){0};
        if (d > 0)
            NAME(kick)(p, mobility[d], e + d, AT(d - 1), AT(d), AT(d + 1));
    }
    for (int i = 0; i < 3; i++)
        e[elements].velocity[i] += mobility[elements] * AT(elements - 1)->back[i];
    e[elements].velocity[2] += p->gravity_kick;
#undef AT
}

/* Valve after its set-point, chamber after its valve. */
INLINE void NAME(follow)(const struct plant *p, int drives, DRIVE *drive)
{
    for (int i = 0; i < drives; i++) {
        drive[i].valve += p->valve_share * (drive[i].goal - drive[i].valve);
        drive[i].force += p->chamber_share * (drive[i].valve - drive[i].force);
    }
}

/* Drift of all elements by `part` of a time step. */
static void NAME(drift)(int elements, ELEMENT *e, double part)
{
    for (int k = 0; k < elements; k++) {
        V w[3];
        for (int i = 0; i < 3; i++) {
            w[i] = part * e[k].omega[i];
            e[k + 1].position[i] += part * e[k + 1].velocity[i];
        }
        NAME(rotate)(e[k].director, w);
    }
}

static void NAME(advance)(const struct plant *p, int block, int modules, int per_module, double *drives,
                          double *state, long steps)
{
    int elements = modules * per_module;
    ELEMENT *e = (ELEMENT *)state + (long)block * (elements + 1);
    DRIVE *drive = (DRIVE *)drives + (long)block * modules * p->actuators;
    if (steps <= 0)
        return;
    NAME(drift)(elements, e, -0.5); /* every sweep drifts by a whole time step, the first one by half */
    for (long s = 0; s < steps; s++) {
        if (p->lags)
            NAME(follow)(p, modules * p->actuators, drive);
        if (p->friction > 0.0)
            NAME(sweep)(p, 1, elements, per_module, drive, e);
        else
            NAME(sweep)(p, 0, elements, per_module, drive, e);
    }
    NAME(drift)(elements, e, 0.5);
}

/* The most that the core can do, for the benchmark: 12 chains of multiply-adds that wait for nobody. */
static double NAME(peak)(long rounds)
{
    V x[12], factor = (V){0} + 0.999999;
    for (int i = 0; i < 12; i++)
        x[i] = factor * (double)i;
    for (long r = 0; r < rounds; r++)
        for (int i = 0; i < 12; i++)
            x[i] = x[i] * factor + factor;
    for (int i = 1; i < 12; i++)
        x[0] += x[i];
    return x[0][0];
}

#undef V
#undef M
#undef INLINE
#undef DOT
#undef ELEMENT
#undef WORK
#undef DRIVE
