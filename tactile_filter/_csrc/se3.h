// SE(3): a pose is rot[9] (row-major) and pos[3], a tangent vector xi[6] = [rho, phi].
// Accurate at all angles up to pi; tactile_filter/se3.py says how.
#ifndef TACTILE_SE3_H_
#define TACTILE_SE3_H_

typedef struct {
  double rot[9];
  double pos[3];
} Pose;

// order of the inverse Jacobian's series; EXACT is the closed form
enum { JACOBIAN_EXACT = 0, JACOBIAN_ORDER_2 = 2, JACOBIAN_ORDER_4 = 4 };

// blocks of the inverse left Jacobian [[diag, corner], [0, diag]]
typedef struct {
  double diag[9];
  double corner[9];
} InverseJacobian;

// res = logarithm of pose
void se3_log(double res[6], const Pose* pose);

// pose = exp(xi^) * pose
void se3_perturb(Pose* pose, const double xi[6]);

// res = a * b, res not among them
void se3_product(Pose* res, const Pose* a, const Pose* b);

// res = a * b^-1
void se3_difference(Pose* res, const Pose* a, const Pose* b);

// res = pose^-1, res not pose
void se3_inverse(Pose* res, const Pose* pose);

// res = a^-1 * b, res not among them
void se3_inverse_product(Pose* res, const Pose* a, const Pose* b);

// inverse left Jacobian at xi, |phi| <= pi
void se3_inverse_jacobian(InverseJacobian* res, const double xi[6], int order);

// one Newton step towards the nearest rotation
void se3_orthonormalize(Pose* pose);

// largest deviation of rot' * rot from the identity
double se3_rotation_error(const double rot[9]);

double se3_determinant(const double rot[9]);

#endif  // TACTILE_SE3_H_
