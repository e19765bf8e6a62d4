// SE(3): a pose is rot[9] (row-major) and pos[3], a tangent vector xi[6] = [rho, phi].
// Accurate at all angles up to pi; tactile_geometry/se3.py says how.
#ifndef TACTILE_SE3_H_
#define TACTILE_SE3_H_

// largest element of R^T R - I for R to count as a rotation, as in se3.py
#define ROTATION_TOLERANCE 1e-6

// m; far more than any arm reaches, and all that is made of it stays finite
#define LARGEST_POSITION 1e9

// order of the inverse left Jacobian's series; EXACT is the closed form
enum { JACOBIAN_EXACT = 0, JACOBIAN_ORDER_2 = 2, JACOBIAN_ORDER_4 = 4 };

typedef struct {
  double rot[9];
  double pos[3];
} Pose;

// the pose of a homogeneous matrix, row-major, whose last row is not looked at; and the other way
// round
void se3_from_matrix(Pose* res, const double mat[16]);
void se3_to_matrix(double res[16], const Pose* pose);

// res = logarithm of pose
void se3_log(double res[6], const Pose* pose);

// rotation vector, |phi| <= pi
void se3_rotation_vector(double res[3], const double rot[9]);

// e = (1 - (t/2) cot(t/2)) / t^2 and (de/dt)/t of t^2 = x <= pi^2
void se3_inverse_coefficients(double res[2], double x);

// sin(t)/t, (1 - cos(t))/t^2, (t - sin(t))/t^3 of t^2 = x
void se3_exp_coefficients(double res[3], double x);

// pose (4, 4) of x, y, z and turns about the fixed x, y and z in turn
int se3_from_euler(double mat[16], const double euler[6]);

// and these of a pose, |beta| <= pi/2; at pi/2, where only alpha and gamma together are defined,
// gamma is 0; returns 0 where the last row is none of a pose
int se3_to_euler(double euler[6], const double mat[16]);

// res = a * b, res not among them
void se3_product(Pose* res, const Pose* a, const Pose* b);

// res = a * b^-1
void se3_difference(Pose* res, const Pose* a, const Pose* b);

// res = pose^-1, res not pose
void se3_inverse(Pose* res, const Pose* pose);

// res = a^-1 * b, res not among them
void se3_inverse_product(Pose* res, const Pose* a, const Pose* b);

// replace the rotation by the nearest one, which is near
void se3_orthonormalize(Pose* pose);

// largest deviation of rot' * rot from the identity
double se3_rotation_error(const double rot[9]);

double se3_determinant(const double rot[9]);

#endif  // TACTILE_SE3_H_
