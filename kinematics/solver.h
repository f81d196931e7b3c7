/* Kinematics of one six-joint arm. No state, no allocation: every function may be called from any thread.
   Angles in rad, lengths in m. q and seed have six values, base to tool. */
#ifndef ARM_KINEMATICS_H
#define ARM_KINEMATICS_H

#ifdef __cplusplus
extern "C" {
#endif

enum {
    ARM_JOINTS = 6,
    ARM_FRAMES = 7,        /* frames 1 to 6, frame i moves with joint i, and the tool */
    ARM_MAX_SOLUTIONS = 16 /* room that arm_solve and arm_nearest need */
};
enum { ARM_BACK = 1, ARM_DOWN = 2, ARM_FLIP = 4 };       /* bits of branch; without: front, up, no-flip */
enum { ARM_SHOULDER = 1, ARM_ELBOW = 2, ARM_WRIST = 4 }; /* bits of singularity */
enum { ARM_INVALID = -1 }; /* a value is NaN or infinite, or a matrix is no rotation */

typedef struct {
    double position[3];
    double rotation[9]; /* 3x3, row by row; its columns are the axes of the frame */
} arm_pose;

typedef struct {
    double q[6];     /* inside the limits where a multiple of 2 pi brings it there, else in (-pi, pi] */
    int branch;      /* bits above */
    int singularity; /* bits above */
    int outside;     /* bit i: joint i+1 is outside its limits */
} arm_solution;

extern const char arm_name[];
extern const char arm_version[]; /* of this interface and its results */
extern const char arm_digest[];  /* SHA-256 of the arm's numbers and names: two files with the same one are the same arm */
extern const char *const arm_joint_names[6];
extern const double arm_lower[6], arm_upper[6];
extern const double arm_velocity[6]; /* rad/s; infinite where unknown */

/* Pose of the tool in the base frame. */
void arm_forward(const double q[6], arm_pose *tool);

/* Poses of frames 1 to 6 and of the tool in the base frame. */
void arm_frames(const double q[6], arm_pose frames[7]);

/* All solutions, at most eight; limits are reported, not enforced. Returns their number, 0 where the pose is out of
   reach, or ARM_INVALID. A joint that is free on a singularity stays at near; NULL is zero, or the limit nearest to it. */
int arm_solve(const arm_pose *pose, const double near[6], arm_solution out[16]);

/* The solutions inside the limits, each joint at the multiple of 2 pi nearest to the seed that the limits allow, nearest
   first: by the largest motion of a joint. Returns their number or ARM_INVALID. */
int arm_nearest(const arm_pose *pose, const double seed[6], arm_solution out[16]);

#ifdef __cplusplus
}
#endif
#endif
