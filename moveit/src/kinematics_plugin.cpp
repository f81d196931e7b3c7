// The class that MoveIt loads: kinematics::KinematicsBase over the closed-form solver in {{ prefix }}_kinematics.c.
// MoveIt 2 where rclcpp is found, else MoveIt 1.
#include <array>
#include <cmath>
#include <string>
#include <vector>

#if __has_include(<rclcpp/rclcpp.hpp>)
#include <geometry_msgs/msg/pose.hpp>
#include <moveit_msgs/msg/move_it_error_codes.hpp>
#include <rclcpp/rclcpp.hpp>
#define MOVEIT_VERSION_OF_ROS 2
#else
#include <geometry_msgs/Pose.h>
#include <moveit_msgs/MoveItErrorCodes.h>
#include <ros/console.h>
#define MOVEIT_VERSION_OF_ROS 1
#endif
#if __has_include(<moveit/kinematics_base/kinematics_base.hpp>)
#include <moveit/kinematics_base/kinematics_base.hpp>
#include <moveit/robot_model/robot_model.hpp>
#include <moveit/robot_state/robot_state.hpp>
#else
#include <moveit/kinematics_base/kinematics_base.h>
#include <moveit/robot_model/robot_model.h>
#include <moveit/robot_state/robot_state.h>
#endif
#include <pluginlib/class_list_macros.hpp>

#include "{{ prefix }}_kinematics.h"

namespace {{ package }}
{
namespace
{
#if MOVEIT_VERSION_OF_ROS == 2
using Pose = geometry_msgs::msg::Pose;
using ErrorCodes = moveit_msgs::msg::MoveItErrorCodes;
#else
using Pose = geometry_msgs::Pose;
using ErrorCodes = moveit_msgs::MoveItErrorCodes;
#endif
using Values = std::vector<double>;

constexpr std::size_t JOINTS = {{ prefix | upper }}_JOINTS, FRAMES = {{ prefix | upper }}_FRAMES;
constexpr double SAME_FRAME = 1e-5;  // m, or an entry of a rotation: what a model rounded to 5 digits may differ by
const std::array<const char*, FRAMES> LINKS{ { "{{ links[1:] | join('", "') }}" } };

void logError(const std::string& sentence)
{
#if MOVEIT_VERSION_OF_ROS == 2
  RCLCPP_ERROR(rclcpp::get_logger("{{ package }}"), "%s", sentence.c_str());
#else
  ROS_ERROR_NAMED("{{ package }}", "%s", sentence.c_str());
#endif
}

// False where the orientation is no rotation: a quaternion that is not near the length 1.
bool toSolver(const Pose& pose, {{ prefix }}_pose& result)
{
  double x = pose.orientation.x, y = pose.orientation.y, z = pose.orientation.z, w = pose.orientation.w;
  const double length = std::sqrt(x * x + y * y + z * z + w * w);
  if (!(std::fabs(length - 1.0) < 1e-3))
    return false;
  x /= length, y /= length, z /= length, w /= length;
  result = { { pose.position.x, pose.position.y, pose.position.z },
             { 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),    //
               2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),    //
               2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y) } };
  return true;
}

Pose toMessage(const {{ prefix }}_pose& pose)
{
  const double* r = pose.rotation;
  // The largest of the four is computed first: no division by a number near zero.
  const double squares[4] = { 1 + r[0] - r[4] - r[8], 1 - r[0] + r[4] - r[8], 1 - r[0] - r[4] + r[8],
                              1 + r[0] + r[4] + r[8] };
  const double products[4][4] = { { squares[0], r[1] + r[3], r[2] + r[6], r[7] - r[5] },
                                  { r[1] + r[3], squares[1], r[5] + r[7], r[2] - r[6] },
                                  { r[2] + r[6], r[5] + r[7], squares[2], r[3] - r[1] },
                                  { r[7] - r[5], r[2] - r[6], r[3] - r[1], squares[3] } };
  int largest = 0;
  for (int i = 1; i < 4; ++i)
    if (squares[i] > squares[largest])
      largest = i;
  const double factor = 0.5 / std::sqrt(squares[largest]);
  Pose result;
  result.position.x = pose.position[0];
  result.position.y = pose.position[1];
  result.position.z = pose.position[2];
  result.orientation.x = factor * products[largest][0];
  result.orientation.y = factor * products[largest][1];
  result.orientation.z = factor * products[largest][2];
  result.orientation.w = factor * products[largest][3];
  return result;
}
}  // namespace

class KinematicsPlugin : public kinematics::KinematicsBase
{
public:
  using Options = kinematics::KinematicsQueryOptions;
  using kinematics::KinematicsBase::initialize;
  using kinematics::KinematicsBase::searchPositionIK;

#if MOVEIT_VERSION_OF_ROS == 2
  bool initialize(const rclcpp::Node::SharedPtr& node, const moveit::core::RobotModel& robot_model,
                  const std::string& group_name, const std::string& base_frame,
                  const std::vector<std::string>& tip_frames, double search_discretization) override
  {
    node_ = node;
    return isForModel(robot_model, group_name, base_frame, tip_frames, search_discretization);
  }
#else
  bool initialize(const moveit::core::RobotModel& robot_model, const std::string& group_name,
                  const std::string& base_frame, const std::vector<std::string>& tip_frames,
                  double search_discretization) override
  {
    return isForModel(robot_model, group_name, base_frame, tip_frames, search_discretization);
  }
#endif

  bool getPositionIK(const Pose& pose, const Values& seed, Values& solution, ErrorCodes& error,
                     const Options& = Options()) const override
  {
    return search(pose, seed, {}, IKCallbackFn(), solution, error);
  }

  bool getPositionIK(const std::vector<Pose>& poses, const Values& seed, std::vector<Values>& solutions,
                     kinematics::KinematicsResult& result, const Options& options) const override
  {
    solutions.clear();
    result.solution_percentage = 0.0;
    if (poses.empty())
      result.kinematic_error = kinematics::KinematicErrors::EMPTY_TIP_POSES;
    else if (poses.size() > 1)
      result.kinematic_error = kinematics::KinematicErrors::MULTIPLE_TIPS_NOT_SUPPORTED;
    else if (options.discretization_method != kinematics::DiscretizationMethods::NO_DISCRETIZATION)
      result.kinematic_error = kinematics::KinematicErrors::UNSUPORTED_DISCRETIZATION_REQUESTED;
    else
    {
      solutions = nearest(poses[0], seed);
      result.kinematic_error = solutions.empty() ? kinematics::KinematicErrors::NO_SOLUTION : kinematics::KinematicErrors::OK;
      result.solution_percentage = solutions.empty() ? 0.0 : 1.0;
    }
    return !solutions.empty();
  }

  bool searchPositionIK(const Pose& pose, const Values& seed, double, Values& solution, ErrorCodes& error,
                        const Options& = Options()) const override
  {
    return search(pose, seed, {}, IKCallbackFn(), solution, error);
  }

  bool searchPositionIK(const Pose& pose, const Values& seed, double, const Values& consistency_limits,
                        Values& solution, ErrorCodes& error, const Options& = Options()) const override
  {
    return search(pose, seed, consistency_limits, IKCallbackFn(), solution, error);
  }

  bool searchPositionIK(const Pose& pose, const Values& seed, double, Values& solution,
                        const IKCallbackFn& callback, ErrorCodes& error, const Options& = Options()) const override
  {
    return search(pose, seed, {}, callback, solution, error);
  }

  bool searchPositionIK(const Pose& pose, const Values& seed, double, const Values& consistency_limits,
                        Values& solution, const IKCallbackFn& callback, ErrorCodes& error,
                        const Options& = Options()) const override
  {
    return search(pose, seed, consistency_limits, callback, solution, error);
  }

  bool getPositionFK(const std::vector<std::string>& link_names, const Values& q, std::vector<Pose>& poses) const override
  {
    poses.clear();
    if (q.size() != JOINTS)
      return false;
    {{ prefix }}_pose frames[FRAMES];
    {{ prefix }}_frames(q.data(), frames);
    for (const std::string& name : link_names)
      for (std::size_t i = 0; i < FRAMES; ++i)
        if (name == LINKS[i])
          poses.push_back(toMessage(frames[i]));
    if (poses.size() == link_names.size())
      return true;
    poses.clear();
    return false;
  }

  const std::vector<std::string>& getJointNames() const override
  {
    return joint_names_;
  }

  const std::vector<std::string>& getLinkNames() const override
  {
    return link_names_;
  }

private:
  // Whether joints and frames of the model are the solver's: compared at three positions of the joints.
  bool isForModel(const moveit::core::RobotModel& model, const std::string& group_name, const std::string& base_frame,
                  const std::vector<std::string>& tip_frames, double search_discretization)
  {
    is_ready_ = false;
    const moveit::core::JointModelGroup* group = model.getJointModelGroup(group_name);
    if (group == nullptr || group->getActiveJointModelNames() != joint_names_)
      return refuse("the joints of group " + group_name + " are not those that the solver was made for");
    if (tip_frames.size() != 1 || tip_frames[0] != LINKS.back())
      return refuse("the only tip of group " + group_name + " must be " + LINKS.back());
    if (!model.hasLinkModel(base_frame))
      return refuse("the base " + base_frame + " is not a link of the model");
    storeValues(model, group_name, base_frame, tip_frames, search_discretization);
    moveit::core::RobotState state(robot_model_);
    state.setToDefaultValues();
    const Values samples[] = { Values(JOINTS, 0.0), { 0.3, 0.5, -0.7, 1.1, 0.9, -1.3 }, { -1.0, -0.4, 0.6, -0.5, -1.2, 2.0 } };
    for (const Values& q : samples)
    {
      {{ prefix }}_pose frames[FRAMES];
      {{ prefix }}_frames(q.data(), frames);
      state.setJointGroupPositions(group, q);
      for (std::size_t i = 0; i < FRAMES; ++i)
      {
        if (!model.hasLinkModel(LINKS[i]))
          return refuse(std::string("the model has no link ") + LINKS[i]);
        const auto frame = state.getGlobalLinkTransform(base_frame).inverse() * state.getGlobalLinkTransform(LINKS[i]);
        for (int row = 0; row < 3; ++row)
          for (int column = 0; column < 4; ++column)
          {
            const double own = column == 3 ? frames[i].position[row] : frames[i].rotation[3 * row + column];
            if (!(std::fabs(frame(row, column) - own) < SAME_FRAME))
              return refuse("the frame " + std::string(LINKS[i]) + " relative to " + base_frame +
                            " is not the solver's: use the URDF of this package");
          }
      }
    }
    return is_ready_ = true;
  }

  static bool refuse(const std::string& reason)
  {
    logError(reason + ". The solver was made for " + {{ prefix }}_name + ".");
    return false;
  }

  // Solutions inside the limits, nearest to the seed first.
  std::vector<Values> nearest(const Pose& pose, const Values& seed) const
  {
    {{ prefix }}_pose wanted;
    {{ prefix }}_solution found[{{ prefix | upper }}_MAX_SOLUTIONS];
    std::vector<Values> result;
    if (!is_ready_ || seed.size() != JOINTS || !toSolver(pose, wanted))
      return result;
    const int count = {{ prefix }}_nearest(&wanted, seed.data(), found);
    for (int i = 0; i < count; ++i)
      result.emplace_back(found[i].q, found[i].q + JOINTS);
    return result;
  }

  static bool isConsistent(const Values& q, const Values& seed, const Values& limits)
  {
    for (std::size_t i = 0; i < limits.size(); ++i)
      if (!(std::fabs(q[i] - seed[i]) <= limits[i]))
        return false;
    return true;
  }

  // The first solution within the consistency limits that the callback accepts. Takes microseconds: no timeout.
  bool search(const Pose& pose, const Values& seed, const Values& consistency_limits, const IKCallbackFn& callback,
              Values& solution, ErrorCodes& error) const
  {
    solution.clear();
    error.val = ErrorCodes::NO_IK_SOLUTION;
    if (!consistency_limits.empty() && consistency_limits.size() != JOINTS)
      return false;
    for (const Values& q : nearest(pose, seed))
    {
      if (!isConsistent(q, seed, consistency_limits))
        continue;
      error.val = ErrorCodes::SUCCESS;
      if (callback)
        callback(pose, q, error);
      if (error.val == ErrorCodes::SUCCESS)
      {
        solution = q;
        return true;
      }
    }
    error.val = ErrorCodes::NO_IK_SOLUTION;
    return false;
  }

  const std::vector<std::string> joint_names_{ {{ prefix }}_joint_names, {{ prefix }}_joint_names + JOINTS };
  const std::vector<std::string> link_names_{ LINKS.begin(), LINKS.end() };
  bool is_ready_ = false;
};
}  // namespace {{ package }}

PLUGINLIB_EXPORT_CLASS({{ package }}::KinematicsPlugin, kinematics::KinematicsBase)
