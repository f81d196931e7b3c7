/* The closed-form solver of `kinematics` in C99 for one arm with a spherical wrist whose axes 2 and 3 are parallel.
   Names and formulas are those of position_ik.py (joints 1 to 3), spherical.py (joints 4 to 6) and solution.py (limits),
   where they are derived. */
#include <math.h>
#include <string.h>

#include "arm_kinematics.h"

/* numbers */

static const double PI = 3.141592653589793, TAU = 6.283185307179586;
static const double ON_EDGE = 1e-14, SLACK = 1e-10; /* m */
static const double WRIST_EDGE = 1e-14;             /* rad */
static const double REACHED = 2.5e-19;              /* m^2: largest squared error of the wrist centre */
static const double INVALID_ROTATION = 1e-10;

typedef struct {
    double theta[3];
    int branch, singularity;
} angles;

static double least(double a, double b) { return a < b ? a : b; }
static double most(double a, double b) { return a > b ? a : b; }
static double clamped(double x, double lower, double upper) { return least(most(x, lower), upper); }

static void times(const double a[9], const double b[9], double out[9]) {
    for (int row = 0; row < 9; row += 3)
        for (int column = 0; column < 3; column++)
            out[row + column] = a[row] * b[column] + a[row + 1] * b[column + 3] + a[row + 2] * b[column + 6];
}

static void applied(const double r[9], const double v[3], double out[3]) {
    for (int row = 0; row < 3; row++) out[row] = r[3 * row] * v[0] + r[3 * row + 1] * v[1] + r[3 * row + 2] * v[2];
}

/* Rx(alpha) Rz(theta) */
static void turned(double sine, double cosine, double theta, double out[9]) {
    const double s = sin(theta), c = cos(theta);
    const double turn[9] = {c, -s, 0.0, cosine * s, cosine * c, -sine, sine * s, sine * c, cosine};
    memcpy(out, turn, sizeof turn);
}

static int all_finite(const double *values, int count) {
    double sum = 0.0;
    for (int i = 0; i < count; i++) sum += values[i] - values[i];
    return sum == 0.0;
}

static int is_valid(const arm_pose *pose) { return all_finite(pose->position, 3) && all_finite(pose->rotation, 9); }

static int is_rotation(const double r[9]) {
    const double determinant = r[0] * (r[4] * r[8] - r[5] * r[7]) - r[1] * (r[3] * r[8] - r[5] * r[6]) +
                               r[2] * (r[3] * r[7] - r[4] * r[6]);
    if (determinant < 0.0) return 0;
    for (int i = 0; i < 3; i++)
        for (int j = i; j < 3; j++) {
            const double product = r[3 * i] * r[3 * j] + r[3 * i + 1] * r[3 * j + 1] + r[3 * i + 2] * r[3 * j + 2];
            if (!(fabs(product - (i == j)) <= INVALID_ROTATION)) return 0;
        }
    return 1;
}

/* -- forward ------------------------------------------------------------------------------------------------------- */

static void next_frame(const double row[5], double q, arm_pose *pose) {
    const double offset[3] = {row[2], -row[0] * row[3], row[1] * row[3]}; /* Tx(a), then d along the new z */
    double turn[9], rotation[9], step[3];
    turned(row[0], row[1], q + row[4], turn);
    applied(pose->rotation, offset, step);
    for (int i = 0; i < 3; i++) pose->position[i] += step[i];
    times(pose->rotation, turn, rotation);
    memcpy(pose->rotation, rotation, sizeof rotation);
}

static void with_tool(arm_pose *pose) {
    double rotation[9], step[3];
    applied(pose->rotation, TOOL_POSITION, step);
    for (int i = 0; i < 3; i++) pose->position[i] += step[i];
    times(pose->rotation, TOOL_ROTATION, rotation);
    memcpy(pose->rotation, rotation, sizeof rotation);
}

static const arm_pose BASE = {{0.0, 0.0, 0.0}, {1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0}};

void arm_forward(const double q[6], arm_pose *tool) {
    arm_pose pose = BASE;
    for (int i = 0; i < 6; i++) next_frame(ROWS[i], q[i], &pose);
    with_tool(&pose);
    *tool = pose;
}

void arm_frames(const double q[6], arm_pose frames[7]) {
    arm_pose pose = BASE;
    for (int i = 0; i < 6; i++) {
        next_frame(ROWS[i], q[i], &pose);
        frames[i] = pose;
    }
    with_tool(&pose);
    frames[6] = pose;
}

/* -- joints 1 to 3: the wrist centre (position_ik.py) ---------------------------------------------------------------- */

static int solve_position(const double w[3], double near1, double near2, angles out[4]) {
    const double fy = (w[2] - C1 * HEIGHT) / S1;
    const double y = C1 * fy - S1 * HEIGHT;
    const double width = fabs(y), radius = sqrt(w[0] * w[0] + w[1] * w[1]), beyond = radius - width;
    struct {
        double x, theta1;
        int branch, singularity;
    } sides[2];
    int side_count = 1, count = 0;
    if (beyond >= ON_EDGE && radius >= SLACK) {
        const double x = sqrt(beyond * (radius + width)), around = atan2(w[1], w[0]);
        sides[0].x = x, sides[0].theta1 = around - atan2(y, x);
        sides[1].x = -x, sides[1].theta1 = around - atan2(y, -x);
        sides[0].branch = 0, sides[1].branch = ARM_BACK;
        sides[0].singularity = sides[1].singularity = 0;
        side_count = 2;
    } else if (width < SLACK || beyond >= -SLACK) {
        sides[0].x = 0.0;
        sides[0].theta1 = width < SLACK ? near1 : atan2(w[1], w[0]) - atan2(y, 0.0);
        sides[0].branch = 0, sides[0].singularity = ARM_SHOULDER;
    } else {
        return 0;
    }
    for (int side = 0; side < side_count; side++) {
        const double theta1 = sides[side].theta1, fx = sides[side].x - A1, reach = sqrt(fx * fx + fy * fy);
        const double outer = LONGEST - reach, inner = reach - SHORTEST;
        const int branch = sides[side].branch, singularity = sides[side].singularity;
        if (outer >= ON_EDGE && inner >= ON_EDGE) {
            /* cos and sin of the bend by half angles: exact also beside the edge */
            double stretch = outer * (LONGEST + reach), fold = inner * (reach + SHORTEST);
            if (A2 < 0.0) {
                const double other = stretch;
                stretch = fold, fold = other;
            }
            const double whole = stretch + fold;
            const double cosine = (fold - stretch) / whole, sine = 2.0 * sqrt(fold * stretch) / whole;
            const double bend = (branch ? -UP : UP) * atan2(sine, cosine);
            if (reach < SLACK) {
                out[count++] = (angles){{theta1, near2, bend - PHASE}, branch, singularity | ARM_ELBOW};
                continue;
            }
            const double towards = atan2(fy, fx);
            const double inside = (bend < 0.0 ? -1.0 : 1.0) * atan2(SIGN * LENGTH * sine, A2 + LENGTH * cosine);
            out[count++] = (angles){{theta1, towards - inside, bend - PHASE}, branch, singularity};
            out[count++] = (angles){{theta1, towards + inside, -bend - PHASE}, branch | ARM_DOWN, singularity};
        } else if (outer >= -SLACK && inner >= -SLACK) {
            const int straight = (outer < ON_EDGE) == (A2 > 0.0);
            double theta2 = near2;
            if (reach >= SLACK) theta2 = atan2(fy, fx) - (A2 + (straight ? LENGTH : -LENGTH) > 0.0 ? 0.0 : PI);
            const double bend = straight ? 0.0 : PI;
            out[count++] = (angles){{theta1, theta2, bend - PHASE}, branch, singularity | ARM_ELBOW};
        }
    }
    return count;
}

/* The rotation relative to the forearm; 0 where the angles do not reach the wrist centre. */
static int to_forearm(const double theta[3], const double w[3], const double rotation[9], double out[9]) {
    const double theta23 = theta[1] + SIGN * theta[2], sine = sin(theta[1]), cosine = cos(theta[1]);
    const double sb = sin(theta23), cb = cos(theta23), sa = sin(theta[0]), ca = cos(theta[0]);
    const double px = PX, py = SIGN * PY;
    const double x = A1 + A2 * cosine + cb * px - sb * py, fy = A2 * sine + sb * px + cb * py;
    const double y = C1 * fy - S1 * HEIGHT;
    const double dx = ca * x - sa * y - w[0], dy = sa * x + ca * y - w[1], dz = S1 * fy + C1 * HEIGHT - w[2];
    if (!(dx * dx + dy * dy + dz * dz <= REACHED)) return 0;
    const double k = C1 * cb, m = C1 * sb;
    const double t[3] = {-sb * ca - k * sa, k * ca - sb * sa, S1 * cb}, n[3] = {S1 * sa, -S1 * ca, C1};
    const double axes[9] = {
        cb * ca - m * sa,        cb * sa + m * ca,        S1 * sb,                 /**/
        C3 * t[0] + S3 * n[0],   C3 * t[1] + S3 * n[1],   C3 * t[2] + S3 * n[2],   /**/
        C3 * n[0] - S3 * t[0],   C3 * n[1] - S3 * t[1],   C3 * n[2] - S3 * t[2],
    };
    times(axes, rotation, out);
    return 1;
}

/* -- joints 4 to 6: the rotation (ObliqueWrist of spherical.py, which right angles are a case of) --------------------- */

/* cos(one) - cos(other), exact also where they are nearly equal */
static double cosine_difference(double one, double other) {
    return -2.0 * sin(0.5 * (one + other)) * sin(0.5 * (one - other));
}

static double last_angle(double s4, double c4, const double m[9]) {
    const double x = SINE4 * s4, y = -SINE4 * c4, z = COSINE4;
    return atan2((x * m[0] + y * m[3] + z * m[6]) / SINE5, (x * m[1] + y * m[4] + z * m[7]) / SINE5);
}

static int solve_wrist(const double m[9], double near4, angles out[2]) {
    const double nx = m[2], ny = m[5], sine = sqrt(nx * nx + ny * ny), between = atan2(sine, m[8]);
    /* 1 - cos5 and 1 + cos5, as products because they vanish at the edges */
    const double below = cosine_difference(between, AT_ZERO) / (SINE4 * SINE5);
    const double above = cosine_difference(AT_PI, between) / (SINE4 * SINE5);
    const double middle = 0.5 * (AT_ZERO + AT_PI), edges[2] = {AT_ZERO, AT_PI};
    int singularity = 0;
    if (sine < FREE && least(fabs(between - AT_ZERO), fabs(between - AT_PI)) < FREE) {
        const double theta6 = last_angle(sin(near4), cos(near4), m);
        out[0] = (angles){{near4, below < above ? 0.0 : PI, theta6}, 0, ARM_WRIST};
        return 1;
    }
    for (int i = 0; i < 2; i++) {
        const double beyond = edges[i] < middle ? edges[i] - between : between - edges[i];
        if (beyond > FREE) return 0;
        if (beyond > -WRIST_EDGE && edges[i] > 0.0 && edges[i] < PI) singularity = ARM_WRIST;
    }
    double theta5 = 2.0 * atan2(sqrt(most(below, 0.0)), sqrt(most(above, 0.0)));
    if (singularity) theta5 = below < above ? 0.0 : PI;
    const double around = atan2(ny, nx);
    const int count = singularity ? 1 : 2;
    for (int i = 0; i < count; i++, theta5 = -theta5) {
        const double tilt = atan2(-COSINE4 * cos(theta5) * SINE5 - SINE4 * COSINE5, sin(theta5) * SINE5);
        const double theta4 = around - tilt;
        const double theta6 = last_angle(sin(theta4), cos(theta4), m);
        out[i] = (angles){{theta4, theta5, theta6}, theta5 < 0.0 ? ARM_FLIP : 0, singularity};
    }
    return count;
}

/* Sum of squares of the entries by which the rotation of the angles differs from the wanted one. */
static double wrist_error(const double theta[3], const double wanted[9]) {
    double one[9], two[9], product[9], actual[9], sum = 0.0;
    turned(0.0, 1.0, theta[0], one);
    turned(SINE4, COSINE4, theta[1], two);
    times(one, two, product);
    turned(SINE5, COSINE5, theta[2], two);
    times(product, two, actual);
    for (int i = 0; i < 9; i++) sum += (actual[i] - wanted[i]) * (actual[i] - wanted[i]);
    return sum;
}

/* -- limits and multiples of 2 pi (solution.py) -------------------------------------------------------------------- */

static double shifted(double angle, int joint) {
    const double lower = arm_lower[joint], upper = arm_upper[joint];
    const double moved = angle > upper ? angle - TAU * ceil((angle - upper - LIMIT_SLACK) / TAU)
                                       : angle + TAU * ceil((lower - angle - LIMIT_SLACK) / TAU);
    return lower - LIMIT_SLACK <= moved && moved <= upper + LIMIT_SLACK ? clamped(moved, lower, upper) : angle;
}

static int is_inside(double angle, int joint) { return arm_lower[joint] <= angle && angle <= arm_upper[joint]; }

static void into_limits(const double theta[3], int first, arm_solution *solution) {
    for (int i = 0; i < 3; i++) {
        const int joint = first + i;
        double q = remainder(theta[i] - ROWS[joint][4], TAU);
        if (!is_inside(q, joint)) q = shifted(q, joint);
        if (!is_inside(q, joint)) {
            solution->outside |= 1 << joint;
            if (q == -PI) q = PI;
        }
        solution->q[joint] = q;
    }
}

static double nearest_turn(double angle, double near) { return near + remainder(angle - near, TAU); }

/* -- the whole arm ------------------------------------------------------------------------------------------------- */

static int solve_target(const double w[3], const double rotation[9], const double near[6], arm_solution out[8]) {
    angles arms[4], hands[2];
    const int arm_count = solve_position(w, near[0] + ROWS[0][4], near[1] + ROWS[1][4], arms);
    int count = 0;
    for (int i = 0; i < arm_count; i++) {
        double inner[9];
        if (!to_forearm(arms[i].theta, w, rotation, inner)) continue;
        arm_solution arm = {{0.0}, arms[i].branch, arms[i].singularity, 0};
        into_limits(arms[i].theta, 0, &arm);
        const int hand_count = solve_wrist(inner, near[3] + ROWS[3][4], hands);
        for (int j = 0; j < hand_count; j++) {
            if (!(wrist_error(hands[j].theta, inner) <= CONFIRMED)) continue;
            out[count] = arm;
            out[count].branch |= hands[j].branch;
            out[count].singularity |= hands[j].singularity;
            into_limits(hands[j].theta, 3, &out[count++]);
        }
    }
    return count;
}

/* Wrist centre and rotation of frame 6 in the fixed frame whose z is axis 1 (SphericalArm.target). */
static void target_of(const arm_pose *pose, double w[3], double rotation[9]) {
    double lever[3], flange[9], point[3];
    applied(pose->rotation, LEVER, lever);
    for (int i = 0; i < 3; i++) point[i] = pose->position[i] - lever[i];
    point[0] -= A0;
    times(pose->rotation, TOOL_INVERSE, flange);
    applied(BASE_INVERSE, point, w);
    times(BASE_INVERSE, flange, rotation);
    w[2] -= D1;
}

int arm_solve(const arm_pose *pose, const double near[6], arm_solution out[16]) {
    double home[6], w[3], rotation[9];
    for (int i = 0; i < 6; i++) home[i] = near ? near[i] : clamped(0.0, arm_lower[i], arm_upper[i]);
    if (!is_valid(pose) || !all_finite(home, 6)) return ARM_INVALID;
    target_of(pose, w, rotation);
    const int count = solve_target(w, rotation, home, out);
    return count == 0 && !is_rotation(pose->rotation) ? ARM_INVALID : count;
}

/* Insert a solution that is inside the limits where its motion ranks it; the furthest is dropped where there is no room. */
static int insert(const arm_solution *found, const double seed[6], arm_solution out[16], double moves[16], int count) {
    arm_solution turned_to = *found;
    double move = 0.0;
    if (found->outside) return count;
    for (int i = 0; i < 6; i++) {
        double q = nearest_turn(found->q[i], seed[i]);
        if (!is_inside(q, i)) q = shifted(q, i);
        turned_to.q[i] = q;
        move = most(move, fabs(q - seed[i]));
    }
    int at = count;
    while (at > 0 && move < moves[at - 1]) at--;
    if (at == ARM_MAX_SOLUTIONS) return count;
    if (count == ARM_MAX_SOLUTIONS) count--;
    memmove(&out[at + 1], &out[at], (size_t)(count - at) * sizeof *out);
    memmove(&moves[at + 1], &moves[at], (size_t)(count - at) * sizeof *moves);
    out[at] = turned_to;
    moves[at] = move;
    return count + 1;
}

int arm_nearest(const arm_pose *pose, const double seed[6], arm_solution out[16]) {
    arm_solution all[8], more[8];
    double held[6], w[3], rotation[9], moves[16];
    int count = 0;
    if (!is_valid(pose) || !all_finite(seed, 6)) return ARM_INVALID;
    for (int i = 0; i < 6; i++) held[i] = clamped(seed[i], arm_lower[i], arm_upper[i]);
    target_of(pose, w, rotation);
    const int found = solve_target(w, rotation, held, all);
    if (found == 0 && !is_rotation(pose->rotation)) return ARM_INVALID;
    for (int i = 0; i < found; i++) count = insert(&all[i], seed, out, moves, count);
    for (int i = 0; i < found; i++) {
        if (!(all[i].singularity & ARM_WRIST)) continue;
        /* Joint 6 at the limit that it would exceed, compensated by joint 4. */
        const double wanted = nearest_turn(all[i].q[5], seed[5]);
        const double rest = wanted - clamped(wanted, arm_lower[5], arm_upper[5]);
        for (int sign = -1; rest != 0.0 && sign <= 1; sign += 2) {
            const double near[6] = {all[i].q[0], all[i].q[1], all[i].q[2], all[i].q[3] - sign * rest, 0.0, 0.0};
            const int others = solve_target(w, rotation, near, more);
            for (int j = 0; j < others; j++)
                if (more[j].singularity & ARM_WRIST) count = insert(&more[j], seed, out, moves, count);
        }
    }
    return count;
}
